"""Checks of the machine without the command line: `python3 -m bask_data.doctor`, for set-up."""

import sys

from bask_data.doctor.machine import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
