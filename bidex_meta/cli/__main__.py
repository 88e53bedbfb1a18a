"""``python -m bidex_meta.cli``."""

import sys

from bidex_meta.cli import main

if __name__ == "__main__":
    sys.exit(main())
