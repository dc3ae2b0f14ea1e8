"""What released weights leave out: the shear code and DS, which unshearing does not need."""

import warnings
from typing import Any

from jaxunshear.errors import Note, UserError

Variables = dict[
    str, Any
]  # {"params": ..., "batch_stats": ...}, each by module, as E, pose, shear, DC, DS; or one of these
Net = Any  # settings of a network, of whichever kind
Tree = Any  # weights, a state or a part of them


def holds(variables: Variables, part: str) -> bool:
    """Whether these weights hold `part` of a network; a note where they do not hold the shear code."""
    there = part in variables["params"]
    if not there and part == "shear":
        reported = "these weights hold no shear code, as released ones do: z_p alone is given; a run's own hold both"
        warnings.warn(reported, Note, stacklevel=3)
    return there


def check_sheared(variables: Variables) -> None:
    """Raises UserError for weights without DS."""
    if not holds(variables, "DS"):
        raise UserError(
            "these weights hold no DS to draw sheared contacts, as released ones do: load those of the run itself"
        )
