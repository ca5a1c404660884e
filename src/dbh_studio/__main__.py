"""``python -m dbh_studio`` is ``dbh-studio``."""

import sys

from dbh_studio.cli import main

if __name__ == "__main__":
    sys.exit(main())
