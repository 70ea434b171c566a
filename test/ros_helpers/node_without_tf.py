"""The node on a machine where tf2_msgs is not installed."""

import sys

from csgm_ros.ros.node import main

sys.modules['tf2_msgs'] = None  # what `import` finds where there is nothing

if __name__ == '__main__':
    sys.exit(main())
