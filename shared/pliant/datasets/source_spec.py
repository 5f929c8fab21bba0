"""The description of a source: one object from the command line to the process that reads it."""

import json
from pathlib import Path
from typing import Literal, Self

from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

from pliant.errors import CalibrationError, DatasetError
from pliant.wording import shown


class SourceSpec(BaseModel):
    """The source of frames and the user's options for it; it travels between processes as JSON.

    location: a file, a folder, or a name such as camera:0.
    calibration: a file that replaces a calibration of the source.
    fov_deg: horizontal field of view, for a guess without any calibration.
    topic: the images of a file that has several; "" if it has one.
    mask: an image, or a folder of them, that masks parts of frames: see ``masks``.
    depth: the depth maps that frames bring along; a source without any is refused then.
    imu, gps: a file of inertial samples or of satellite fixes, or their topic in a file that has
    topics; "": those that the source brings along.

    Raises CalibrationError for a calibration and a field of view together.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    location: str
    calibration: Path | None = None
    fov_deg: float | None = None
    topic: str = ""
    mask: Path | None = None
    depth: Literal["none", "first", "all"] = "none"
    imu: str = ""
    gps: str = ""

    @model_validator(mode="after")
    def _one_camera(self) -> Self:
        if self.calibration is not None and self.fov_deg is not None:
            raise CalibrationError("--calibration and --fov exclude each other: pass only one")
        return self

    def to_json(self) -> str:
        """JSON for ``parse``, by the standard library: it keeps file names that are not UTF-8."""
        return json.dumps(self.model_dump(exclude_defaults=True), default=str)

    @classmethod
    def parse(cls, text: str) -> Self:
        """From JSON.  Raises DatasetError for anything else."""
        try:
            return cls.model_validate(json.loads(text))
        except ValidationError as error:
            first = error.errors()[0]
            fault = f"{'.'.join(str(part) for part in first['loc'])}: {first['msg']}"
        except ValueError as error:
            fault = f"not JSON: {error}"
        raise DatasetError(f"--source {shown(text)}: {fault}")

    def at(self, location: Path) -> Self:
        """The same frames at another place."""
        return self.model_copy(update={"location": str(location)})
