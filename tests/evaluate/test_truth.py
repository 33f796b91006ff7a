"""Truth files of every kind, valid and invalid."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from octoreplay.config.class_file import class_table
from octoreplay.errors import InputError
from octoreplay.evaluate.truth import load_truth
from octoreplay.mapping.octree import codes_to_keys
from octoreplay.simulate.village import make_village
from octoreplay.simulate.world import village_classes
from octoreplay.simulate.world_files import labelled_cells, write_ground_truth, write_mesh
from support.long_suite import long

CLASSES = class_table(
    [{"name": "ground", "color": [10, 20, 30], "raw_labels": [7]}, {"name": "tree", "color": [1, 2, 250]}]
)
FIXTURES = Path(__file__).parents[1] / "fixtures"


def save_world(path: Path, **changes: object) -> Path:
    """A world.npz of three cells; arrays that are None are left out."""
    arrays: dict[str, object] = {
        "keys": np.array([[1, 0, 0], [0, 0, 0], [-1, -2, 3]], np.int32), "class_ids": np.array([2, 1, 1], np.uint8),
        "resolution": np.float64(0.5), "class_names": np.array(["ground", "tree"]), **changes,
    }  # fmt: skip
    np.savez_compressed(path, **{name: array for name, array in arrays.items() if array is not None})
    return path


def classes_by_key(path: Path, resolution: float = 0.5, table: object = CLASSES) -> dict[tuple[int, ...], int]:
    truth = load_truth(path, table, resolution)  # type: ignore[arg-type]
    assert (np.diff(truth.codes) > 0).all()
    keys = codes_to_keys(truth.codes).tolist()
    return dict(zip(map(tuple, keys), truth.class_ids.tolist(), strict=True))


def save_ply(path: Path, points: object, labels: object = None, faces: object = None, **options: object) -> Path:
    """A PLY file of points with optional labels and optional faces [(vertices, label)]."""
    kinds = [("x", "f4"), ("y", "f4"), ("z", "f4"), *([] if labels is None else [("label", "u2")])]
    rows = [(*point, *([] if labels is None else [labels[i]])) for i, point in enumerate(points)]
    elements = [PlyElement.describe(np.array(rows, kinds), "vertex")]
    if faces is not None:
        table = np.empty(len(faces), [("vertex_indices", "O"), ("label", "u1")])
        for index, (corners, label) in enumerate(faces):
            table[index] = (np.array(corners, np.int32), label)
        elements.append(PlyElement.describe(table, "face"))
    PlyData(elements, **options).write(str(path))
    return path


# --- world.npz --------------------------------------------------------------------------------------------------------


def test_classes_of_a_world_are_matched_by_name(tmp_path: Path) -> None:
    path = save_world(tmp_path / "world.npz")
    assert classes_by_key(path) == {(1, 0, 0): 2, (0, 0, 0): 1, (-1, -2, 3): 1}
    assert classes_by_key(tmp_path) == classes_by_key(path)
    swapped = save_world(tmp_path / "swapped.npz", class_names=np.array(["tree", "ground"]))
    assert classes_by_key(swapped) == {(1, 0, 0): 1, (0, 0, 0): 2, (-1, -2, 3): 2}


def test_a_class_that_the_result_does_not_have_becomes_no_class(tmp_path: Path) -> None:
    path = save_world(tmp_path / "world.npz", class_names=np.array(["ground", "water"]))
    assert classes_by_key(path) == {(1, 0, 0): 0, (0, 0, 0): 1, (-1, -2, 3): 1}
    assert load_truth(path, CLASSES, 0.5).is_class.sum() == 2


def test_class_ids_without_names_are_raw_labels(tmp_path: Path) -> None:
    path = save_world(tmp_path / "world.npz", class_names=None, class_ids=np.array([2, 7, 300], np.uint16))
    assert classes_by_key(path) == {(1, 0, 0): 2, (0, 0, 0): 1, (-1, -2, 3): 0}


def test_merged_classes_are_found_by_their_raw_labels(tmp_path: Path) -> None:
    merged = class_table(
        [{"name": "ground", "color": [1, 2, 3], "raw_labels": [1]},
         {"name": "plants", "color": [3, 2, 1], "raw_labels": [2, 3]}]
    )  # fmt: skip
    names = np.array(["ground", "tree", "bush"])
    path = save_world(tmp_path / "world.npz", class_ids=np.array([3, 2, 1], np.uint8), class_names=names)
    assert sorted(classes_by_key(path, table=merged).values()) == [1, 2, 2]
    # Here the truth's numbers are not the raw labels, so 'bush' has no class.
    assert sorted(classes_by_key(path).values()) == [0, 1, 2]


def test_finer_cells_vote_for_the_class(tmp_path: Path) -> None:
    keys = [(-1, 0, 0), (0, 0, 0), (1, 1, 1), (0, 1, 0), (2, 0, 0), (3, 0, 0)]
    ids = np.array([2, 1, 2, 2, 2, 1], np.uint8)
    path = save_world(tmp_path / "world.npz", keys=np.array(keys), class_ids=ids, resolution=np.float64(0.1))
    # Three votes to one at the origin; the tie in the next cell goes to the lower id.
    assert classes_by_key(path, 0.2) == {(-1, 0, 0): 2, (0, 0, 0): 2, (1, 0, 0): 1}
    assert classes_by_key(path, 0.3) == {(-1, 0, 0): 2, (0, 0, 0): 2, (1, 0, 0): 1}
    assert classes_by_key(path, 0.1) == dict(zip(keys, ids.tolist(), strict=True))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"keys": None}, "has no array 'keys'"),
        ({"class_ids": None}, "has no array 'class_ids'"),
        ({"resolution": None}, "has no array 'resolution'"),
        ({"keys": np.zeros((3, 2), np.int32)}, r"must have the shapes \(M, 3\) and \(M,\), not \(3, 2\)"),
        ({"class_ids": np.zeros(2, np.uint8)}, r"must have the shapes \(M, 3\) and \(M,\)"),
        ({"keys": np.full((3, 3), 0.5)}, "must be integers"),
        ({"class_ids": np.array(["a", "b", "c"])}, "must be integers"),
        ({"resolution": np.float64(0.2)}, r"has cells of 0\.2 m, and the result's 0\.5 m are no multiple of that"),
        ({"resolution": np.float64(1.0)}, "has cells of 1 m, and the result's 0.5 m are no multiple of that"),
        ({"resolution": np.float64(np.nan)}, "'resolution' must be"),
        ({"resolution": np.float64(-0.5)}, "'resolution' must be"),
        ({"resolution": np.array([0.5, 0.5])}, "'resolution' must be"),
        ({"resolution": np.array("fine")}, "'resolution' must be"),
        ({"class_names": np.array([1, 2])}, "'class_names' must be"),
        ({"class_names": np.array(["sky", "water"])}, "no class in common .* classes are ground, tree"),
        ({"keys": np.zeros((0, 3), np.int32), "class_ids": np.zeros(0, np.uint8)}, "holds no surface"),
        ({"keys": np.array([[0, 0, 0], [0, 0, 1], [1 << 18, 0, 0]])}, "reaches beyond 131 km"),
        ({"keys": np.array([[0, 0, 0], [0, 0, 1], [2**62, 0, 0]])}, "reaches beyond 131 km"),
        ({"keys": np.array([[{}]], dtype=object)}, "cannot be read, or is truncated or damaged"),
    ],
)  # fmt: skip
def test_invalid_worlds_are_refused(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    path = save_world(tmp_path / "world.npz", **changes)
    with pytest.raises(InputError, match=rf"^{re.escape(str(path))}: .*{message}"):
        load_truth(path, CLASSES, 0.5)


def test_a_world_truncated_anywhere_is_refused(tmp_path: Path) -> None:
    whole = save_world(tmp_path / "world.npz").read_bytes()
    for length in range(0, len(whole), 7):
        (tmp_path / "cut.npz").write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"cut\.npz: "):
            load_truth(tmp_path / "cut.npz", CLASSES, 0.5)


def test_a_world_with_a_damaged_byte_is_refused_or_has_the_same_classes(tmp_path: Path) -> None:
    path = tmp_path / "world.npz"
    whole, expected = save_world(path).read_bytes(), classes_by_key(path)
    for place in range(0, len(whole), 3):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0x55]) + whole[place + 1 :])
        try:
            # A damaged list of names may be missing; then the class_ids are raw labels.
            assert set(classes_by_key(path)) == set(expected)
        except InputError as error:
            assert str(error).startswith(f"{path}: ")  # noqa: PT017 - one of several outcomes


def test_files_of_other_kinds_are_refused(tmp_path: Path) -> None:
    for name, message in (
        ("a.txt", r"ends in \.npz or \.ply, not '\.txt'"),
        ("b.npz", "cannot be read"),
        ("c.ply", ""),
    ):
        (tmp_path / name).write_bytes(b"not a truth")
        with pytest.raises(InputError, match=rf"{name}: .*{message}"):
            load_truth(tmp_path / name, CLASSES, 0.5)
    np.save(tmp_path / "d.npy", np.zeros(3))
    (tmp_path / "d.npy").rename(tmp_path / "d.npz")
    with pytest.raises(InputError, match=r"d\.npz: is a single array"):
        load_truth(tmp_path / "d.npz", CLASSES, 0.5)
    with zipfile.ZipFile(tmp_path / "e.npz", "w") as file:
        file.writestr("keys.npy", b"\x93NUMPY")
    with pytest.raises(InputError, match=r"e\.npz: cannot be read"):
        load_truth(tmp_path / "e.npz", CLASSES, 0.5)
    with pytest.raises(InputError, match=r"world\.npz: not found"):
        load_truth(tmp_path, CLASSES, 0.5)
    with pytest.raises(InputError, match=r"none\.ply: not found"):
        load_truth(tmp_path / "none.ply", CLASSES, 0.5)


# --- PLY --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [{"text": True}, {"byte_order": "<"}, {"byte_order": ">"}])
def test_labelled_points_vote_for_the_class(tmp_path: Path, options: dict[str, object]) -> None:
    points = [(0.1, 0.1, 0.1), (0.4, 0.1, 0.1), (0.2, 0.4, 0.1), (-0.1, 0.0, 0.0), (0.6, 0.1, 0.1)]
    path = save_ply(tmp_path / "cloud.PLY", points, [2, 7, 2, 7, 99], **options)
    assert classes_by_key(path) == {(0, 0, 0): 2, (-1, 0, 0): 1, (1, 0, 0): 0}


def test_labelled_faces_fill_the_cells_that_they_intersect(tmp_path: Path) -> None:
    points = [(0.1, 0.1, 0.1), (3.9, 0.1, 0.1), (3.9, 2.9, 0.1), (0.1, 2.9, 0.1), (0.1, 0.1, 2.9)]
    faces = [((0, 1, 2, 3), 7), ((0, 3, 4), 2)]
    found = classes_by_key(save_ply(tmp_path / "mesh.ply", points, faces=faces), 1.0)
    floor = {(x, y, 0) for x in range(4) for y in range(3)}
    # Cells in the plane x = 0.1 below the line from (y, z) = (2.9, 0.1) to (0.1, 2.9).
    wall = {(0, 0, 1), (0, 0, 2), (0, 1, 1), (0, 0, 0), (0, 1, 0), (0, 2, 0)}
    assert floor | wall <= set(found) <= floor | wall | {(0, 1, 2), (0, 2, 1)}
    assert {found[key] for key in floor - wall} == {1}
    assert found[0, 0, 1] == found[0, 0, 2] == found[0, 1, 1] == 2
    # The two triangles of the square give the same floor.
    triangles = [((0, 1, 2), 7), ((0, 2, 3), 7)]
    assert set(classes_by_key(save_ply(tmp_path / "floor.ply", points, faces=triangles), 1.0)) == floor


def test_labels_of_faces_take_precedence_over_those_of_vertices(tmp_path: Path) -> None:
    path = save_ply(tmp_path / "a.ply", [(0, 0, 0), (1, 0, 0), (0, 1, 0)], [2, 2, 2], [((0, 1, 2), 7)])
    assert set(classes_by_key(path).values()) == {1}


@pytest.mark.parametrize(
    ("points", "labels", "faces", "message"),
    [
        ([(0, 0, 0)], None, None, "neither its faces nor its vertices have labels"),
        ([(0, 0, 0)], [9], None, "no class in common"),
        ([(np.nan, 0, 0)], [7], None, "not finite"),
        ([(1e9, 0, 0)], [7], None, "reaches beyond 131 km"),
        ([(0, 0, 0), (1e9, 0, 0), (0, 1, 0)], None, [((0, 1, 2), 7)], "reaches beyond 131 km"),
        ([(0, 0, 0), (90_000, 0, 0), (0, 90_000, 0)], None, [((0, 1, 2), 7)], r"would take 5\.8e\+11 points"),
        ([(0, 0, 0), (1, 0, 0), (0, 1, 0)], None, [((0, 1, 5), 7)], "a face has a vertex index out of range"),
        ([(0, 0, 0), (1, 0, 0)], None, [((0, 1), 7)], "holds no surface"),
        ([], [], None, "holds no surface"),
    ],
)
def test_invalid_ply_files_are_refused(
    tmp_path: Path, points: object, labels: object, faces: object, message: str
) -> None:
    path = save_ply(tmp_path / "a.ply", points, labels, faces)
    with pytest.raises(InputError, match=rf"^{re.escape(str(path))}: .*{message}"):
        load_truth(path, CLASSES, 0.5)


# --- files of the simulator -------------------------------------------------------------------------------------------


@long
def test_the_mesh_and_the_cells_of_the_simulator_give_the_same_truth(tmp_path: Path) -> None:
    world, classes = make_village(24.0, 3), village_classes(1)
    write_ground_truth(tmp_path / "world.npz", world, 0.4, classes)
    write_mesh(tmp_path / "world.ply", world, classes)
    cells = classes_by_key(tmp_path, 0.4, classes)
    keys, class_ids = labelled_cells(world, 0.4)
    assert cells == dict(zip(map(tuple, keys.tolist()), class_ids.tolist(), strict=True))
    # The mesh also has surface below the ground.
    mesh = classes_by_key(tmp_path / "world.ply", 0.4, classes)
    same = [mesh.get(key) == class_id for key, class_id in cells.items()]
    assert np.mean(same) > 0.99
    coarse = classes_by_key(tmp_path, 0.8, classes)
    assert set(coarse) == {tuple(k // 2 for k in key) for key in cells}


@pytest.mark.parametrize("team", ["pair", "trio"])
def test_the_truth_of_the_recorded_teams_can_be_read(team: str) -> None:
    truth = load_truth(FIXTURES / team, village_classes(1), 0.3)
    assert truth.is_class.all()
    assert len(truth.codes) > 20_000
