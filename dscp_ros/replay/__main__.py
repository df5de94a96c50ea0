"""`python -m dscp_ros.replay`."""

import sys

from dscp_ros.replay.main import main

if __name__ == "__main__":
    sys.exit(main())
