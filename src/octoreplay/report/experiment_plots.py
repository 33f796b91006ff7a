"""Results of the experiments as figures, from the rows of their sweeps (docs/experiments.md)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from octoreplay.config.rules import RULES, Exchanged
from octoreplay.report.experiment_tables import (
    SITUATIONS,
    Key,
    Row,
    Tables,
    groups,
    mean,
    of_noise,
    variant,
    with_summed_evidence,
)
from octoreplay.report.figures import (
    BLUE,
    COLORS,
    GREEN,
    GREY,
    MARKERS,
    ORANGE,
    label_plainly,
    legend_below,
    new_figure,
    style,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_RULE_COLORS = {"local": GREY, "gradient": BLUE, "bayes": ORANGE, "central": GREEN}


def figures(name: str, found: Tables) -> dict[str, Figure]:
    """Return the figures of an experiment by file name."""
    makers = {"rules": _rules, "steps": _steps, "scale": _scale, "noise": _noise, "choose": _choose}
    return makers[name](found)


def _rules(found: Tables) -> dict[str, Figure]:
    """Disagreement, agreement, IoU and bytes: one line per rule, one marker per graph."""
    rows = found["rules"]
    labels = list(dict.fromkeys(variant(row) for row in rows))
    figure = new_figure(13.0, 5.2)
    panels = figure.subplots(1, 4, sharey=True)
    for axes, (column, title, scale) in zip(
        panels,
        (("total_distance_all_log_end", "Φ over all pairs, end of the logs", 1.0),
         ("agreement_occupied_mean", "agreement over the logs, occupied", 1.0),
         ("mean_iou", "mean IoU, settled", 1.0),
         ("sent_bytes_per_second", "kB per robot and second", 1e-3)),
        strict=True,
    ):  # fmt: skip
        style(axes, title)
        for index, ((topology,), part) in enumerate(groups(rows, "topology").items()):
            values = {variant(own[0]): own for own in groups(part, "rule", "evidence", "gamma", "gamma_power").values()}
            places = [labels.index(label) + 0.16 * (index - 1.5) for label in values]
            axes.plot(
                [mean(own, column) * scale for own in values.values()], places, MARKERS[index], color=COLORS[index],
                markersize=5, label=topology,
            )  # fmt: skip
        if column == "sent_bytes_per_second":
            axes.set_xscale("log")
            label_plainly(axes.xaxis)
    panels[0].set_xscale("log")
    panels[2].axvline(mean(with_summed_evidence(rows), "central_mean_iou"), color="black", linewidth=1, linestyle="--")
    panels[0].set_yticks(range(len(labels)), labels, fontsize=9)
    panels[0].invert_yaxis()
    legend_below(figure, panels[0])
    return {"rules.png": figure}


def _steps(found: Tables) -> dict[str, Figure]:
    """Step sizes against each other, and the bound of epsilon."""
    return {"steps.png": _trade_off(found["steps"]), "bound.png": _bound(found["bound"])}


def _trade_off(rows: Sequence[Row]) -> Figure:
    """Every pair of step sizes as a square, for the rules with both."""
    columns = (
        ("total_distance_all_log_end", "Φ over all pairs, end of the logs", "{:.1e}"),
        ("agreement_occupied_mean", "agreement over the logs, occupied", "{:.3f}"),
        ("agreement_occupied", "agreement, settled, occupied", "{:.4f}"),
    )
    by_rule = groups(rows, "rule")
    figure = new_figure(13.0, 3.4 * len(by_rule))
    panels = figure.subplots(len(by_rule), len(columns), squeeze=False)
    for line, ((rule,), part) in zip(panels, by_rule.items(), strict=True):
        for axes, (column, title, form) in zip(line, columns, strict=True):
            _squares(axes, part, column, form)
            axes.set_title(f"{rule}: {title}", loc="left", fontsize=10)
    return figure


def _squares(axes: Axes, rows: Sequence[Row], column: str, form: str) -> None:
    """Draw the mean of a column for every epsilon and gamma into squares; darker is worse."""
    epsilons, gammas = ([key for (key,) in groups(rows, name)] for name in ("epsilon", "gamma"))
    cells = groups(rows, "epsilon", "gamma")
    values = np.array([[mean(cells.get((e, g), []), column) for g in gammas] for e in epsilons])
    shade = -np.log10(np.maximum(values, 1e-12)) if column.startswith("total") else values
    axes.imshow(shade, cmap="viridis", aspect="auto")
    middle = np.nanmean([np.nanmin(shade), np.nanmax(shade)])
    for (y, x), value in np.ndenumerate(values):
        color = "white" if shade[y, x] < middle else "black"
        axes.text(x, y, form.format(value), ha="center", va="center", fontsize=7.5, color=color)
    axes.set_xticks(range(len(gammas)), gammas)
    axes.set_yticks(range(len(epsilons)), epsilons)
    axes.set_xlabel("gamma")
    axes.set_ylabel("epsilon")


def _bound(rows: Sequence[Row]) -> Figure:
    """Factor of Phi per settling tick: theory as lines, measurements as markers."""
    figure = new_figure(7.0, 4.2)
    axes = style(figure.add_subplot(), "Mixing (bayes, settling)", "epsilon / bound", "factor of Φ per tick")
    for index, ((topology,), part) in enumerate(groups(rows, "topology").items()):
        shares = [row["epsilon_share"] for row in part]
        for name, form, label in (("contraction_theory", "-", f"{topology}, theory"), ("contraction", "", topology)):
            values = [row[name] for row in part]
            axes.plot(
                shares, values, form or MARKERS[index], color=COLORS[index], label=label, markersize=5, linewidth=1.2
            )
    axes.axvline(1.0, color="black", linewidth=1, linestyle="--")
    axes.axhline(1.0, color="black", linewidth=1, linestyle=":")
    axes.set_ylim(0.0, 1.25)
    legend_below(figure, axes)
    return figure


def _scale(found: Tables) -> dict[str, Figure]:
    """Speed, memory and bytes over robots, resolution and classes."""
    figure = new_figure(12.0, 8.0)
    panels = figure.subplots(3, 3, sharex="col", sharey="row")
    quantities = (
        ("realtime_factor", "real-time factor", 1.0),
        ("peak_rss_bytes", "peak memory [MB]", 1e-6),
        ("sent_bytes_per_second", "kB per robot and second", 1e-3),
    )
    for column, (plan, name, x_label, series) in enumerate((
        ("robots", "num_robots", "robots", ("topology", "resolution")),
        ("resolution", "resolution", "resolution [m]", ("rule",)),
        ("classes", "num_classes", "classes", ("rule",)),
    )):  # fmt: skip
        for line, (quantity, label, factor) in enumerate(quantities):
            axes = style(panels[line, column], "", x_label if line == 2 else "", label if column == 0 else "")
            for index, (key, rows) in enumerate(groups(found[plan], *series).items()):
                label_of_line = " ".join(map(str, key)) + (" m" if plan == "robots" else "")
                _line(axes, rows, name, quantity, factor, COLORS[index + (2 if plan == "robots" else 0)], label_of_line)
            axes.set_yscale("log")
            label_plainly(axes.yaxis)
            axes.set_xscale("log")
            ticks = [float(key) for (key,) in groups(found[plan], name)]
            axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks], minor=False)
            axes.set_xticks([], minor=True)
            if quantity == "realtime_factor":
                axes.axhline(1.0, color="black", linewidth=1, linestyle="--")
                axes.legend(frameon=False, fontsize=9)
    return {"scale.png": figure}


def _line(axes: Axes, rows: Sequence[Row], x: str, y: str, factor: float, color: str, label: str) -> None:
    """Draw the means of a column over another one."""
    points = {float(key): mean(part, y) * factor for (key,), part in groups(rows, x).items()}
    axes.plot(list(points), list(points.values()), "o-", color=color, markersize=4, linewidth=1.5, label=label)


_NOISES = {
    "label_noise": "share of wrong labels",
    "pose_noise": "pose noise [m]",
    "depth_noise": "depth noise, multiple of the camera's",
}


def _noise(found: Tables) -> dict[str, Figure]:
    """IoU, calibration error, and labels corrected and made wrong, over each kind of noise."""
    figure = new_figure(12.0, 8.5)
    panels = figure.subplots(3, 3, sharex="col", sharey="row")
    titles = ("mean IoU", "calibration error, occupied cells", "corrected, made wrong (share)")
    for column, (kind, x_label) in enumerate(_NOISES.items()):
        rows = of_noise(found["noise"], kind)
        iou, calibration, change = panels[:, column]
        for axes, title in zip(panels[:, column], titles, strict=True):
            style(axes, "", x_label if axes is change else "", "" if column else title)
        _line(iou, rows, kind, "central_mean_iou", 1.0, _RULE_COLORS["central"], "centralised")
        _line(
            calibration, rows, kind, "central_calibration_error_occupied", 1.0, _RULE_COLORS["central"], "centralised"
        )
        for (rule,), part in groups(rows, "rule").items():
            color = _RULE_COLORS[rule]
            _line(iou, part, kind, "mean_iou", 1.0, color, rule)
            _line(calibration, part, kind, "calibration_error_occupied", 1.0, color, rule)
            if RULES[rule].exchanges is not Exchanged.NOTHING:
                _line(change, part, kind, "repaired", 1.0, color, f"{rule}: corrected")
                _line(change, part, kind, "spread", 1.0, color, f"{rule}: made wrong")
                change.lines[-1].set_linestyle("--")
    for axes in panels[:, 0]:
        axes.legend(frameon=False, fontsize=9)
    return {"noise.png": figure}


def _choose(found: Tables) -> dict[str, Figure]:
    """Agreement of the worst robot over the logs against the bytes sent, for each choice."""
    figure = new_figure(13.0, 4.6)
    panels = figure.subplots(1, len(SITUATIONS), sharey=True)
    rules = list(dict.fromkeys(str(row["rule"]) for rows in found.values() for row in rows))
    forms: list[Key] = list(dict.fromkeys(key for rows in found.values() for key in groups(rows, "packets", "content")))
    for axes, plan in zip(panels, SITUATIONS, strict=True):
        style(axes, plan.replace("_", " "), "kB per robot and second")
        for (rule, *sent), part in groups(found[plan], "rule", "packets", "content").items():
            axes.plot(
                mean(part, "sent_bytes_per_second") / 1e3, mean(part, "agreement_occupied_mean"),
                MARKERS[forms.index(tuple(sent))], color=COLORS[rules.index(rule)], markersize=7,
            )  # fmt: skip
        axes.set_xscale("log")
        label_plainly(axes.xaxis)
    panels[0].set_ylabel("agreement over the logs, occupied, worst robot")
    for rule, color in zip(rules, COLORS, strict=False):
        panels[0].plot([], [], "o", color=color, label=rule)
    for form, marker in zip(forms, MARKERS, strict=False):
        panels[0].plot([], [], marker, color=GREY, label=" ".join(form))
    legend_below(figure, panels[0], columns=len(rules) + len(forms))
    return {"choose.png": figure}
