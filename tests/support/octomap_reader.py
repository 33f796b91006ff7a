"""Reader of OctoMap's tree files, node by node as the format describes them."""

from __future__ import annotations

import struct
from pathlib import Path

DEPTH = 16


def read_octomap(path: Path) -> tuple[dict[str, str], dict[tuple[int, int, int, int], tuple[object, ...]]]:
    """Return the header, and every leaf's value by its lowest key (three integers) and its edge in cells.

    The values are (is_occupied,) of a ``.bt`` file, and (log-odds, red, green, blue) of a ``.ot`` file. The number of
    nodes is under ``nodes read`` in the header.
    """
    head, data = path.read_bytes().split(b"data\n", 1)
    header = dict(line.split(" ", 1) for line in head.decode().splitlines() if not line.startswith("#"))
    header["first line"] = head.decode().splitlines()[0]
    leaves: dict[tuple[int, int, int, int], tuple[object, ...]] = {}
    place, num_nodes = 0, 1

    def corner(key: tuple[int, int, int], child: int, edge: int) -> tuple[int, int, int]:
        return tuple(value + (child >> axis & 1) * edge for axis, value in enumerate(key))

    def binary(key: tuple[int, int, int], depth: int) -> None:
        nonlocal place, num_nodes
        bits = int.from_bytes(data[place : place + 2], "little")
        place += 2
        edge = 1 << (DEPTH - depth - 1)
        children = [bits >> 2 * child & 3 for child in range(8)]
        num_nodes += sum(state > 0 for state in children)
        for child, state in enumerate(children):
            if state in (1, 2):
                leaves[*corner(key, child, edge), edge] = (state == 2,)
        for child, state in enumerate(children):
            if state == 3:
                binary(corner(key, child, edge), depth + 1)

    def full(key: tuple[int, int, int], depth: int) -> None:
        nonlocal place, num_nodes
        log_odds, *color, children = struct.unpack_from("<f4B", data, place)
        place += 8
        edge = 1 << (DEPTH - depth)
        if not children:
            leaves[*key, edge] = (log_odds, *color)
        for child in range(8):
            if children >> child & 1:
                num_nodes += 1
                full(corner(key, child, edge // 2), depth + 1)

    lowest = (-(1 << (DEPTH - 1)),) * 3
    (binary if path.suffix == ".bt" else full)(lowest, 0)
    assert place == len(data)
    header["nodes read"] = str(num_nodes)
    return header, leaves
