"""The tables of docs/results.md: the commands that make each, and how the page shows the output.

A name in a command that is that of a sequence stands for its folder.  What a command writes lies in
the folder of the raw results.
"""

import re
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby

from benchmarks.table import markdown

Rows = list[list[str]]
"""The cells of a table; the first row is its header."""


def _after(option: str, words: Sequence[str]) -> list[str]:
    return [words[i + 1] for i, word in enumerate(words) if word == option]


@dataclass(frozen=True)
class Output:
    """What a command printed."""

    command: str
    text: str

    def table(self) -> Rows:
        """The first table of it.  Raises ValueError where it has none."""
        lines = [line for line in self.text.splitlines() if line.startswith("|")]
        if not lines:
            raise ValueError(f"no table in the output of: {self.command}")
        return [cells_of(line) for line in lines if not re.fullmatch(r"[| -]+", line)]


def cells_of(line: str) -> list[str]:
    """The cells of a line of a Markdown table."""
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


def as_printed(outputs: Sequence[Output]) -> str:
    """One after the other; rows below a header that is already there continue that table."""
    blocks: list[str] = []
    header = ""
    for output in outputs:
        if not re.search(r"^\|", output.text, re.MULTILINE):
            blocks += [f"```\n{output.text.strip()}\n```"] if output.text.strip() else []
            header = ""
            continue
        for is_table, some in groupby(output.text.splitlines(), lambda line: line[:1] == "|"):
            lines = [line for line in some if line.strip()]
            if is_table and lines[0] == header:
                blocks[-1] = "\n".join([blocks[-1], *lines[2:]])
            elif lines:
                blocks.append("\n".join(lines))
                header = lines[0] if is_table else ""
    return "\n\n".join(blocks)


def final_online(outputs: Sequence[Output]) -> str:
    """Of ``in-process``: a row for each sequence, a column for each seed or setting."""
    found: dict[str, dict[str, str]] = {}
    columns: list[str] = []
    for output in outputs:
        words = shlex.split(output.command)
        sets = [key.split("=")[0].split(".")[-1] for key in _after("--set", words)]
        for sequence, seed, final, online, share in output.table()[1:]:
            seeds = f"seed {seed}" if "--seeds" in words else ""
            column = ", ".join([*sets, seeds] if seeds else sets) or "default"
            columns += [] if column in columns else [column]
            posed = float(share.rstrip(" %"))
            at = f" at {share}" if posed < 99.0 else ""
            found.setdefault(sequence, {})[column] = f"{final} / {online}{at}"
    rows = [[name, *(cells.get(each, "") for each in columns)] for name, cells in found.items()]
    return markdown(["sequence", *columns], rows)


OTHERS = {
    "7scenes_redkitchen400": ("3.26 cm, 93.0 %, 17 ms", "3.32 cm, 94.2 %, 47 ms", "22 cm, fails"),
    "tsukuba150": ("11.9 mm, 74.7 %", "5.5 mm, 92.0 %", "24 cm, fails"),
    "tsdfold_50": ("3.6 mm, 78.0 %", "2.9 mm, 98.0 %", "1.8 mm, 46.0 %"),
    "kitti_nn_seq1": ("never initialises", "4.0 cm, 98.0 %", "fails"),
    "tum_fr1_xyz": ("10 mm, 99 %, 25 ms", "9.5 mm, 98 %", "not run"),
}
"""ATE RMSE, share of the frames with a pose and CPU time per frame of stella_vslam, ORB-SLAM3 and
DSO, measured once with their own programs (2026-11-27)."""


def compared_with_others(outputs: Sequence[Output]) -> str:
    """Of ``accuracy``: its sequences beside ``OTHERS``."""
    rows: Rows = []
    for output in outputs:
        header, *ours = output.table()
        for row in ours:
            of = dict(zip(header, row, strict=True))
            mine = ", ".join(of[name] for name in ("ATE, final", "frames with a pose"))
            mine += f", {of['CPU ms/frame']} ms"
            rows.append([of["sequence"], mine, *OTHERS[of["sequence"]]])
    return markdown(["sequence", "Pliant", "stella_vslam", "ORB-SLAM3", "DSO"], rows)


@dataclass(frozen=True)
class Table:
    """One table, or several of one topic.

    commands: as on the page.  Of ``pliant run`` the output is not shown.    minutes: about, on the
    machine of the page.    shown: the tables of what the others printed.
    """

    minutes: int
    commands: tuple[str, ...]
    shown: Callable[[Sequence[Output]], str] = as_printed


_BENCH = "scripts/bench"
_PATHS = "tsukuba150 7scenes_redkitchen400 tsdfold_50 kitti_nn_seq1 tum_fr1_xyz tartanair_189"
_LIGHT = f"in-process {_PATHS} kitti_00_small1018 built-in:room built-in:corridor"
_MESHED = {
    "built-in:room": "room",
    "built-in:tabletop": "tabletop",
    "built-in:corridor": "corridor",
    "7scenes_redkitchen400": "redkitchen",
}

TABLES: dict[str, Table] = {
    "accuracy": Table(
        6,
        (
            f"{_BENCH} accuracy tsukuba150 7scenes_redkitchen400 tsdfold_50 kitti_nn_seq1 "
            "euroc_v101_still30 built-in:room built-in:tabletop built-in:corridor",
        ),
    ),
    "seeds": Table(
        30,
        (
            f"{_BENCH} in-process tsukuba150 built-in:room built-in:corridor --seeds 4",
            f"{_BENCH} in-process tartanair_189 tum_fr1_rpy_first360 7scenes_redkitchen400 "
            "tum_fr1_xyz kitti_00_small1018 --seeds 3",
        ),
        final_online,
    ),
    "long": Table(3, (f"{_BENCH} accuracy kitti_00_small1018 tum_fr1_xyz",)),
    "map-sizes": Table(2, (f"{_BENCH} map-sizes 200 400 1000 3000",)),
    "kept": Table(
        8,
        tuple(
            f"{_BENCH} in-process {sequence}{kept}{keyframes}"
            for sequence, most in (("kitti_00_small1018", 67_000), ("tum_fr1_xyz", 280_000))
            for kept, keyframes in (
                ("", ""),
                (f" --set bundle_adjustment.window.kept_observations={most}", ""),
                (
                    f" --set bundle_adjustment.window.kept_observations={most}",
                    " --set bundle_adjustment.window.kept_per_keyframe=500",
                ),
            )
        ),
        final_online,
    ),
    "colmap": Table(10, (f"{_BENCH} colmap tsukuba150 built-in:room",)),
    "others": Table(
        5,
        (
            f"{_BENCH} accuracy 7scenes_redkitchen400 tsukuba150 tsdfold_50 kitti_nn_seq1 "
            "tum_fr1_xyz",
        ),
        compared_with_others,
    ),
    "phone-clip": Table(3, (f"{_BENCH} phone-clip tum_fr1_xyz",)),
    "flights": Table(120, (f"{_BENCH} drone-flights euroc_gt_leftcam",)),
    "any-size": Table(
        12,
        (
            f"{_BENCH} any-size 7scenes_redkitchen400 --size 320x240 --size 640x480 "
            "--size 1440x1080 --size 2880x2160 --frames 100",
            f"{_BENCH} any-size kitti_nn_seq1 --size 1226x370 --size 408x123 --size 320x96",
            f"{_BENCH} any-size built-in:room --size 320x240 --size 320x96 --size 640x480 "
            "--size 1280x960 --size 1920x1440 --frames 45",
        ),
    ),
    "unknown-lens": Table(
        40,
        (
            f"{_BENCH} unknown-lens tsukuba150",
            f"{_BENCH} unknown-lens fox_ingp_half",
            f"{_BENCH} unknown-lens tum_fr1_xyz --frames 300",
            f"{_BENCH} unknown-lens 7scenes_redkitchen400 --frames 150",
            f"{_BENCH} unknown-lens built-in:corridor built-in:room",
        ),
    ),
    "coverage": Table(
        4, (f"{_BENCH} coverage fountain_p11_q tsukuba150 tsdfold_50 fox_ingp_half",)
    ),
    "rough": Table(40, (f"{_BENCH} rough rigid",)),
    "tracks-and-map": Table(
        3,
        (
            "pliant run built-in:room --output results/room --force",
            "pliant eval results/room --groundtruth built-in:room --tracks --map",
        ),
    ),
    "tracking": Table(1, (f"{_BENCH} tracking built-in:room",)),
    "light": Table(
        12,
        (f"{_BENCH} {_LIGHT}", f"{_BENCH} {_LIGHT} --set tracking.max_tracks=2000"),
        final_online,
    ),
    "light-cpu": Table(12, (f"{_BENCH} light built-in:room tum_fr1_xyz 7scenes_redkitchen400",)),
    "budget": Table(2, (f"{_BENCH} budget 7scenes_redkitchen400",)),
    "codec": Table(1, (f"{_BENCH} codec",)),
    "ceres": Table(10, (f"{_BENCH} bundle --problems bundle_adjustment --plot bundle.png",)),
    "meshing": Table(
        20,
        tuple(
            command
            for source, name in _MESHED.items()
            for command in (
                f"pliant run {source} --output results/{name} --force --set meshing.depth=points",
                f"{_BENCH} mesh results/{name} --groundtruth {source}",
            )
        ),
    ),
    "mesh-live": Table(
        8,
        (
            "pliant run built-in:court --output results/court --force",
            f"{_BENCH} mesh-live results/court --groundtruth built-in:court",
        ),
    ),
    "mesh-parts": Table(1, (f"{_BENCH} mesh-parts",)),
}
"""By name, in the order of the page."""
