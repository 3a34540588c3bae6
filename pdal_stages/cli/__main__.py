"""``python -m pdal_stages.cli``."""

import sys

from pdal_stages.cli import main

if __name__ == "__main__":  # not in workers
    sys.exit(main())
