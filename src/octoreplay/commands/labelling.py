"""Command that labels a log with a segmentation network: label."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from octoreplay.commands.console import prints, terminal
from octoreplay.commands.exit_codes import EXIT_DATA_LOST
from octoreplay.commands.options import (
    RareOption,
    SectionedCommand,
    check_output,
    existing_path,
    force_option,
    log_place,
    numbers,
)
from octoreplay.commands.progress import progress_bar
from octoreplay.commands.suggestions import Choice
from octoreplay.config.class_tables.label_rows import BUILT_IN
from octoreplay.config.file_url import InputFile
from octoreplay.errors import ConfigError


def _numbers(name: str, text: str | None, counts: tuple[int, ...]) -> tuple[float, ...] | None:
    """Numbers of an option; None without it."""
    if text is None:
        return None
    count = len(text.split(","))
    return numbers(name, text, count if count in counts else counts[-1])


def _size(text: str | None) -> tuple[int, int] | None:
    """Width and height of a text WxH; None without it."""
    if text is None:
        return None
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal() and len(text) < 20):
        raise ConfigError(f"input_size: expects WIDTHxHEIGHT such as 640x480, got '{text}'")
    return int(width), int(height)


@click.command(cls=SectionedCommand, short_help="Label a log with a segmentation network.")
@click.argument("log", type=log_place, metavar="LOG")
@click.option("--model", type=existing_path, required=True, metavar="FILE.onnx", help="semantic segmentation network")
@click.option("--classes", required=True, metavar="NAME|FILE",
              help=f"class table of the network's labels: {', '.join(BUILT_IN)}, or a file")  # fmt: skip
@click.option("-o", "--output", type=existing_path, required=True, metavar="LOG.labelled.mcap", help="log to write")
@click.option(
    "--sensor-topic", metavar="TOPIC", help="depth images or clouds to label  [default: those that a run maps]"
)
@click.option("--colour-topic", metavar="TOPIC", help="colour images  [default: those nearest to the sensor by name]")
@click.option("--aligned", is_flag=True, help="the depth image is registered to the colour image; use no extrinsics")
@click.option("--extrinsics", metavar="X,Y,Z,QX,QY,QZ,QW",
              help="pose of the colour camera in the sensor's frame, instead of TF [m]")  # fmt: skip
@click.option(
    "--colour-intrinsics", metavar="FX,FY,CX,CY", help="instead of the CameraInfo, without distortion [pixels]"
)
@click.option("--pair-tolerance", type=float, default=0.05, show_default=True,
              help="largest distance of the stamps of a sensor message and its colour image [s]")  # fmt: skip
@click.option("--every", type=int, default=1, show_default=True, metavar="N", help="label every N-th sensor message")
@click.option("--label-offset", type=int, default=0, show_default=True, metavar="N",
              help="raw label of the network's first class")  # fmt: skip
@click.option("--input-size", metavar="WxH", help="size of the network's input  [default: the model's, or the image's]")
@click.option("--scale", type=float, help="factor on pixels 0 to 255  [default: the model's metadata, or 1/255]")
@click.option("--mean", metavar="M|R,G,B", help="subtracted after --scale  [default: the model's metadata, or 0]")
@click.option("--std", metavar="S|R,G,B", help="divisor after --mean  [default: the model's metadata, or 1]")
@click.option(
    "--channels", type=Choice(("rgb", "bgr")), help="order of the channels  [default: the metadata's, or rgb]"
)
@click.option("--layout", type=Choice(("nchw", "nhwc")), cls=RareOption,
              help="order of the axes of input and output  [default: by the input's shape]")  # fmt: skip
@click.option("--output-name", metavar="NAME", cls=RareOption, help="output to use  [default: the model's first]")
@click.option("--output-kind", type=Choice(("auto", "logits", "probabilities", "labels")), default="auto",
              cls=RareOption, show_default=True, help="meaning of the output's values")  # fmt: skip
@click.option("--threads", type=click.IntRange(0, 1024), default=0, cls=RareOption, metavar="N",
              help="threads of the network; 0: one for each core  [default: 0]")  # fmt: skip
@click.option("--resume", is_flag=True, help="continue an interrupted labelling; ends with the same bytes")
@click.option("--restart", is_flag=True, help="remove the finished labels of an interrupted labelling, and begin anew")
@force_option
@prints
def label(
    log: InputFile, model: Path, classes: str, output: Path, sensor_topic: str | None, colour_topic: str | None,
    aligned: bool, extrinsics: str | None, colour_intrinsics: str | None, pair_tolerance: float, every: int,
    input_size: str | None, mean: str | None, std: str | None, resume: bool, restart: bool, **network: Any,
) -> int:  # fmt: skip
    """Label the depth images or clouds of a log with a segmentation network, and write a log that a run can map.

    The network is an ONNX file. It sees the colour images of the log and runs on the CPU. Its labels are transferred to
    the depth images or clouds, by projection where the cameras differ.
    """
    from octoreplay.config.class_file import named_class_table
    from octoreplay.io.remote_files import local_copy
    from octoreplay.labelling.finished_frames import check_unstarted
    from octoreplay.labelling.label_log import LabelOptions, label_log
    from octoreplay.labelling.network import NetworkOptions
    from octoreplay.labelling.streams import StreamOptions
    from octoreplay.report.label_tables import label_tables
    from octoreplay.report.tables import size

    if resume and restart:
        raise click.UsageError("--resume continues an earlier labelling and --restart removes it; give one of them")
    check_output(output, ".mcap", [log])
    if not resume and not restart:
        check_unstarted(output)
    table = named_class_table(classes)
    options = LabelOptions(
        StreamOptions(
            sensor_topic, colour_topic, _numbers("extrinsics", extrinsics, (7,)),
            _numbers("colour_intrinsics", colour_intrinsics, (4,)), aligned,
        ),
        NetworkOptions(
            _size(input_size), _numbers("mean", mean, (1, 3)), _numbers("std", std, (1, 3)), **network
        ),
        pair_tolerance, every,
    )  # fmt: skip
    # A download has a bar of its own.
    local_copy(log)
    with progress_bar("label") as update:
        summary = label_log(
            log, output, model, table, options, resume=resume, progress=lambda share, text: update(share, None, text)
        )
    here = terminal()
    here.show(*label_tables(summary))
    for robot in summary.robots:
        if robot.num_undecodable:
            here.warn(f"{robot.robot_id}: {robot.num_undecodable:,} sensor messages or colour images could not be read")
    if summary.damage is not None:
        here.warn(summary.damage)
    here.line(f"wrote {output} ({size(output.stat().st_size)})")
    here.give(log=output, **vars(summary))
    lost = summary.damage is not None or any(robot.num_undecodable for robot in summary.robots)
    return EXIT_DATA_LOST if lost else 0
