"""Entry point of ``python -m octoreplay``."""

from octoreplay.cli import main

if __name__ == "__main__":
    main()
