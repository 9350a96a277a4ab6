"""`python -m bask_data.cli` is the command `bask-data`."""

from bask_data.cli.app import main

if __name__ == "__main__":
    main()
