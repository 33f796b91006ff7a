"""The documentation names what there is."""

import dataclasses
import importlib.util
import math
import re
from pathlib import Path
from types import ModuleType

import click
import pytest

import octoreplay
from octoreplay import cli
from octoreplay.config.parameters import PARAMETERS
from octoreplay.config.rules import RULES, Exchanged
from octoreplay.evaluate.records import EvaluatedTick, MapScores, TruthScores
from octoreplay.io.messages.ros_types import OCTOREPLAY_MSGS
from octoreplay.io.results.map_views import VIEW_DTYPE
from octoreplay.run_metrics import PAIR_SHARES, LinkMetrics, PairMetrics, RobotMetrics, TickMetrics
from octoreplay.study.numbers import RUN_COLUMNS, TIMING_COLUMNS, TRUTH_COLUMNS
from octoreplay.study.questions import QUESTIONS

DOCS = Path(__file__).parents[1] / "docs"


def named(page: str) -> set[str]:
    """Everything that a page sets in code type."""
    return set(re.findall(r"`([^`\n]+)`", (DOCS / page).read_text(encoding="utf-8")))


@pytest.mark.parametrize("record", [TickMetrics, RobotMetrics, LinkMetrics, PairMetrics])
def test_every_metric_is_explained(record: type) -> None:
    fields = {item.name for item in dataclasses.fields(record)}
    assert fields - {"robots", "links", "pairs", "robot_id", "sender", "receiver"} <= named("metrics.md")


def test_every_score_of_a_map_is_explained() -> None:
    fields = {item.name for record in (MapScores, TruthScores, EvaluatedTick) for item in dataclasses.fields(record)}
    fields |= set(PAIR_SHARES)
    assert fields - {"robot_id", "is_active", "truth", "tick", "seconds", "maps"} <= named("evaluation.md")


def test_every_message_and_field_of_the_result_is_explained() -> None:
    words = named("result-format.md")
    for name in ("MapState", "Packet", "TickMetrics", "Contradiction"):
        assert f"octoreplay_msgs/msg/{name}" in OCTOREPLAY_MSGS
        assert f"octoreplay_msgs/msg/{name}" in words
    assert set(VIEW_DTYPE.names or ()) <= words


def test_every_column_of_a_sweep_is_explained() -> None:
    words = named("sweeps.md")
    for name in (*RUN_COLUMNS, *TRUTH_COLUMNS, *TIMING_COLUMNS):
        base = re.sub("_(log_end|mean)$", "", name)
        assert name in words or (base in words and "_log_end" in words and "_mean" in words), name


def test_every_command_and_option_is_explained() -> None:
    text = (DOCS / "cli.md").read_text(encoding="utf-8")
    outputs = text.split("## Output\n")[1].split("\n## ")[0]
    assert all(f"`{option}`" in outputs for option in ("--json", "-q", "--quiet", "-v", "--verbose"))
    common = ("output", "inputs", "result", "folder", "logs", "teams", "is_json", "is_quiet", "is_verbose")
    for name, command in cli.cli.commands.items():
        assert f"## octoreplay {name}" in text
        section = text.split(f"## octoreplay {name}")[1].split("\n## ")[0]
        if name == "run":
            continue
        parts = command.commands if isinstance(command, click.Group) else {}
        assert all(f"octoreplay {name} {part}" in section for part in parts)
        for parameter in (*command.params, *(option for part in parts.values() for option in part.params)):
            if parameter.name not in (*common, *PARAMETERS):
                assert any(option in section for option in (*parameter.opts, *parameter.secondary_opts)), parameter.name


def test_links_between_pages_lead_somewhere() -> None:
    root = DOCS.parent
    pages = [root / "README.md", root / "CONTRIBUTING.md", root / "CHANGELOG.md", *sorted(DOCS.glob("*.md"))]
    assert len(pages) > 5
    for page in pages:
        for target in re.findall(r"\]\((?!https?:)([^)#]+)\)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name} -> {target}"


def test_every_page_has_a_place_in_the_navigation() -> None:
    navigation = (DOCS.parent / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:\n")[2].partition("\n\n")[0]
    assert {page.name for page in DOCS.glob("*.md")} <= set(re.findall(r"[a-z-]+\.md", navigation))


def test_every_public_name_is_in_the_python_reference() -> None:
    page = (DOCS / "api.md").read_text(encoding="utf-8")
    names = set(re.findall(r"^::: octoreplay\.(\w+)$", page, re.MULTILINE))
    assert names | {"__version__"} == set(octoreplay.__all__)


def test_the_page_on_extension_names_files_that_exist() -> None:
    page = (DOCS / "how-to-extend.md").read_text(encoding="utf-8")
    paths = set(re.findall(r"`((?:[a-z_]+/)+[a-z_]+(?:\.[a-z]+)?)`", page)) - {"io/containers/xyz_log.py"}
    assert len(paths) > 15
    for path in paths:
        assert (DOCS.parent / path).exists() or (DOCS.parent / "src" / "octoreplay" / path).exists(), path


def tool(name: str) -> ModuleType:
    """Module of a script in docs/tools."""
    spec = importlib.util.spec_from_file_location(name, DOCS / "tools" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_on_experiments_has_the_tables_of_the_stored_runs() -> None:
    script = tool("experiment_tables")
    page = script.PAGE.read_text(encoding="utf-8")
    folders = sorted({path.parent.name for path in (DOCS / "experiments").glob("*/*.csv")})
    assert folders
    for name in folders:
        stored = page.partition(f"<!-- {name} -->\n")[2].partition(script.END)[0]
        runs = script.stored_runs(DOCS / "experiments" / name)
        assert stored == script.page_tables(QUESTIONS[name], runs), "run python docs/tools/experiment_tables.py"
        titles = [table.title for table in QUESTIONS[name].tables(runs)]
        assert len(set(titles)) == len(titles), f"two tables of {name} have one title"


def test_the_runs_of_the_experiments_are_small() -> None:
    sizes = [path.stat().st_size for path in (DOCS / "experiments").glob("*/*.csv")]
    assert sum(sizes) < 5e6


def traits_table() -> str:
    """Table of the rules' traits as the page on the algorithm shows it."""
    heads = (
        "rule", "packets hold", "ε", "γ", "flows", "quantum", "modes", "packets", "exact in spite of losses",
        "of restarts",
    )  # fmt: skip
    lines = [f"| {' | '.join(heads)} |", "|" + "---|" * len(heads)]
    for rule in RULES.values():
        flags = ["yes" if flag else "" for flag in (rule.has_step_size, rule.has_gamma, rule.has_flows)]
        quantum = f"2^{math.frexp(rule.default_quantum)[1] - 1}" if rule.default_quantum else ""
        exact = ["yes" if flag else "no" for flag in (rule.survives_losses, rule.survives_restarts)]
        sends = rule.exchanges is not Exchanged.NOTHING
        cells = [
            f"`{rule.name}`", rule.exchanges.value, *flags, quantum, ", ".join(f"`{mode}`" for mode in rule.modes),
            ", ".join(f"`{kind}`" for kind in rule.packets) if sends else "", *(exact if sends else ("", "")),
        ]  # fmt: skip
        lines.append(f"| {' | '.join(cells)} |".replace("|  |", "| |").replace("|  |", "| |"))
    return "\n".join(lines) + "\n"


def test_the_page_on_the_algorithm_has_the_traits_of_every_rule() -> None:
    page = (DOCS / "algorithm.md").read_text(encoding="utf-8")
    assert page.partition("<!-- traits -->\n")[2].partition("<!-- end -->")[0] == traits_table()


def test_the_page_of_data_sets_has_the_descriptions_of_the_source() -> None:
    module = tool("data_sets")
    text = module.PAGE.read_text(encoding="utf-8")
    assert text == module.page(text), "run python docs/tools/data_sets.py"
    assert all(f"| `{name}` |" in text for name in module.DATA_SETS)
