from __future__ import annotations

import pytest

from octoreplay.errors import InputError, counted, printable


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("a.mcap: topic '/depth' not found", "a.mcap: topic '/depth' not found"),
        ("topic 'Tiefe \u00e4'", "topic 'Tiefe \u00e4'"),
        ("topic '\x1b[2J\x07'", "topic '\\x1b[2J\\x07'"),
        ("frame 'a\nb'", "frame 'a\\nb'"),
        ("frame '\x00\r\u2028'", "frame '\\x00\\r\\u2028'"),
        ("frame '\udc80'", "frame '\\udc80'"),
        ("put one of these lines:\n    depth_topic: /a\n    depth_topic: /b",
         "put one of these lines:\n    depth_topic: /a\n    depth_topic: /b"),
    ],
)  # fmt: skip
def test_control_characters_in_messages_are_escaped(text, shown):
    assert printable(text) == shown
    assert str(InputError(text)) == shown


def test_a_single_thing_is_in_the_singular():
    assert [counted(number, "robot") for number in (0, 1, 1200)] == ["0 robots", "1 robot", "1,200 robots"]
