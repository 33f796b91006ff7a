"""Entry point of the command ``octoreplay`` and of ``python -m octoreplay``.

The signal handlers are set before anything else is imported, so that an interrupt during an import ends as any other.
"""

from octoreplay import interrupts


def main() -> None:
    """Run the command line and exit with its code."""
    code = interrupts.EXIT_CODE
    try:
        interrupts.install()
        from octoreplay import cli

        cli.main()
    except KeyboardInterrupt:
        interrupts.say()
    except ImportError as error:
        if not interrupts.is_received():
            code = 1
            interrupts.say(f"error: octoreplay is not installed completely ({error}); install it again")
    interrupts.ignore()
    raise SystemExit(code)


if __name__ == "__main__":
    main()
