"""`python -m zsdata` is the `zsdata` command."""

import sys

from zsdata.cli import main

if __name__ == "__main__":
    sys.exit(main())
