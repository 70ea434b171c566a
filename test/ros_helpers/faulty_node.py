"""The node, some of whose parts raise the first time they are used."""

import sys

from csgm_ros import registration
from csgm_ros.ros.inputs import CloudInput
from csgm_ros.ros.node import main
from csgm_ros.ros.outputs import Outputs
from csgm_ros.ros.pairing import Pairing

PARTS = [(registration, 'warm_up'), (CloudInput, 'follow_offers'), (Pairing, '_on_cancel'), (Outputs, 'destroy')]


def break_once(owner, name):
    healthy = getattr(owner, name)

    def fail(*_, **__):
        setattr(owner, name, healthy)
        raise RuntimeError('as asked')

    setattr(owner, name, fail)


if __name__ == '__main__':
    for part in PARTS:
        break_once(*part)
    sys.exit(main())
