"""The base of every parameter model: frozen, and strict about unknown names."""

from pydantic import BaseModel, ConfigDict


class Parameters(BaseModel):
    """A frozen set of parameters.  A misspelt or unknown name is an error at every level."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
