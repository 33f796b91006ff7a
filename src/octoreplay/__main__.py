"""``python -m octoreplay``: the command line."""

from octoreplay.cli import main

if __name__ == "__main__":
    main()
