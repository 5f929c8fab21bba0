"""Tracks on the Earth: GPX 1.1, and GeoJSON (RFC 7946)."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated, Any
from xml.sax.saxutils import escape

from pliant.algorithms.arrays import F64, I64, Shape
from pliant.formats.text import write_lines

_FIRST_DATE_NS = 631_152_000 * 10**9
"""1990: earlier stamps count from elsewhere."""


@dataclass(frozen=True, kw_only=True)
class EarthTrack:
    """Positions in WGS84, degrees and metres.   about: lines for people."""

    stamps_ns: Annotated[I64, Shape("N")]
    latitude_deg: Annotated[F64, Shape("N")]
    longitude_deg: Annotated[F64, Shape("N")]
    altitude_m: Annotated[F64, Shape("N")]
    about: str = ""

    def rows(self) -> Iterator[tuple[int, float, float, float]]:
        """(stamp, latitude, longitude, altitude) of each position."""
        columns = (self.stamps_ns, self.latitude_deg, self.longitude_deg, self.altitude_m)
        yield from zip(*(column.tolist() for column in columns), strict=True)


def write_gpx(path: Path, track: EarthTrack) -> None:
    """A track of one segment; with times where the stamps are dates."""
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<gpx version="1.1" creator="Pliant" xmlns="http://www.topografix.com/GPX/1/1">',
        f"<trk><desc>{escape(track.about)}</desc><trkseg>",
    ]
    for stamp, latitude, longitude, altitude in track.rows():
        time = f"<time>{_date(stamp)}</time>" if stamp >= _FIRST_DATE_NS else ""
        lines.append(
            f'<trkpt lat="{latitude:.9f}" lon="{longitude:.9f}"><ele>{altitude:.4f}</ele>'
            f"{time}</trkpt>"
        )
    write_lines(path, [*lines, "</trkseg></trk></gpx>"])


def write_geojson(path: Path, track: EarthTrack, properties: dict[str, Any]) -> None:
    """A line, with the times of its points in seconds.   properties: more of the feature."""
    rows = list(track.rows())
    feature = {
        "type": "Feature",
        "properties": {
            "about": track.about,
            **properties,
            "coordinateProperties": {"times": [round(1e-9 * row[0], 9) for row in rows]},
        },
        "geometry": {
            "type": "LineString",
            "coordinates": [[round(r[2], 9), round(r[1], 9), round(r[3], 4)] for r in rows],
        },
    }
    write_lines(path, [json.dumps(feature)])


def _date(stamp_ns: int) -> str:
    seconds, fraction = divmod(stamp_ns, 10**9)
    date = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=seconds)
    return f"{date:%Y-%m-%dT%H:%M:%S}.{fraction // 10**6:03d}Z"
