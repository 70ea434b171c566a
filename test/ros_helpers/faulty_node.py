"""The node, one of whose parts raises the first time it is used: FAULT says which."""

import os
import sys

from csgm_ros import pipeline
from csgm_ros.ros.inputs import CloudInput
from csgm_ros.ros.node import main
from csgm_ros.ros.registration import Registration

PARTS = {
    'configure': (pipeline, 'warm_up'),
    'activate': (CloudInput, 'open'),
    'deactivate': (CloudInput, 'close'),
    'callback': (Registration, 'cancel'),
}


def break_once(owner, name):
    healthy = getattr(owner, name)

    def fail(*_, **__):
        setattr(owner, name, healthy)
        raise RuntimeError('as asked')

    setattr(owner, name, fail)


if __name__ == '__main__':
    break_once(*PARTS[os.environ['FAULT']])
    sys.exit(main())
