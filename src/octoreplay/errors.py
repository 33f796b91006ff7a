"""The errors that octoreplay raises on purpose.

::

    OctoreplayError           one sentence: what, where, what to do
    +-- InputError            a log, a result or a data folder cannot be used        (exit code 1)
    +-- OutputError           a file cannot be written                               (exit code 1)
    +-- ConfigError           an option, a team file or a parameter is wrong         (exit code 2)
    +-- PacketError           bytes that are not a map packet this version can read  (exit code 1)
"""


class OctoreplayError(Exception):
    """Base of all errors that octoreplay raises on purpose; its text is one sentence for the user."""


class InputError(OctoreplayError):
    """A log, a result or a data folder is missing, damaged or lacks what a run needs."""


class OutputError(OctoreplayError):
    """A file or folder cannot be written."""


class ConfigError(OctoreplayError):
    """An option, a team file or a parameter is unknown, of the wrong type or out of range."""


class PacketError(OctoreplayError):
    """Bytes that are no map packet, are damaged, or come from a newer format version."""
