"""Faults, long: see scripts/soak.  Every run must end with the bytes of the undisturbed one."""

import argparse
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "system"))

from benchmarks import latency
from benchmarks.table import markdown
from soak_kills import (
    MESH,
    POINTS,
    POWER_CUT,
    ROOM,
    ROOM_ONCE,
    ROUTER,
    SURFELS,
    Kind,
    long_kind,
    rows,
    undisturbed,
)
from soak_network import hostile_rows, latency_rows, network_rows

from pliant_services.runtime.kernels import compile_kernels

VICTIMS: dict[str, list[tuple[Kind, str]]] = {
    **{name: [(POINTS, name)] for name in POINTS.services},
    "all": [(POINTS, "all at once")],
    "power": [(POINTS, POWER_CUT)],
    "router": [(POINTS, ROUTER)],
    "meshing": [(MESH, "meshing")],
    "room": [(ROOM, name) for name in (*ROOM.services, "all at once")],
    "room_cuts": [(ROOM_ONCE, POWER_CUT), (ROOM_ONCE, ROUTER)],
    "surfels": [(SURFELS, name) for name in ("ingest", "surfels", "recorder")],
}
FAULTS = {"network": network_rows, "hostile": hostile_rows}
PARTS = (*VICTIMS, "long", *FAULTS, "latency")


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("kills", type=int, nargs="?", default=20, help="of each")
    parser.add_argument("seed", type=int, nargs="?", default=0)
    parser.add_argument("--parts", type=lambda text: text.split(","), default=list(PARTS),
                        help=f"some of {','.join(PARTS)}")  # fmt: skip
    chosen = parser.parse_args()
    compile_kernels(print)
    whole = True
    victims = [pair for part in chosen.parts for pair in VICTIMS.get(part, [])]
    with tempfile.TemporaryDirectory(prefix="pliant-soak-") as folder:
        if "long" in chosen.parts:
            kind = long_kind(Path(folder) / "room")
            victims += [(kind, name) for name in (*kind.services, "all at once")]
        if victims:
            whole = _kills(victims, chosen.kills, chosen.seed)
    faults: list[Callable[[dict[str, str]], object]] = [
        FAULTS[part] for part in chosen.parts if part in FAULTS
    ]
    if faults:
        whole = _faults(faults) and whole
    if "latency" in chosen.parts:
        print("\n" + markdown(latency.HEADING, latency_rows()), flush=True)
    return 0 if whole else 1


def _kills(victims: list[tuple[Kind, str]], kills: int, seed: int) -> bool:
    print("| killed | times | same bytes |\n|---|---|---|")
    whole = True
    for (kind, _), tally in zip(victims, rows(victims, kills, seed), strict=True):
        of = {SURFELS: " (deformable)", ROOM: " (room)", ROOM_ONCE: " (room)"}
        name = tally.victim + of.get(kind, f" ({kind.frames} frames)" if kind.each > 5 else "")
        print(f"| {name} | {tally.kills} | {tally.same} |", flush=True)
        whole = whole and tally.same == tally.kills >= kills
    return whole


def _faults(faults) -> bool:
    print("\n| fault | same bytes | told meanwhile |\n|---|---|---|")
    whole = True
    with tempfile.TemporaryDirectory(prefix="pliant-soak-") as folder:
        expected = undisturbed(POINTS, Path(folder) / "run")
    for rows_of in faults:
        for fault, same, told in rows_of(expected):
            print(f"| {fault} | {same} | {told} |", flush=True)
            whole = whole and same
    return whole


if __name__ == "__main__":
    sys.exit(main())
