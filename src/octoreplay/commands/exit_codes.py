"""Exit codes of the commands (docs/cli.md)."""

from octoreplay import interrupts

EXIT_ERROR, EXIT_USAGE, EXIT_DATA_LOST, EXIT_INTERRUPTED = 1, 2, 3, interrupts.EXIT_CODE
