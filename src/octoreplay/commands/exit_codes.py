"""Exit codes of the commands (docs/cli.md)."""

EXIT_ERROR, EXIT_USAGE, EXIT_DATA_LOST, EXIT_INTERRUPTED = 1, 2, 3, 130
