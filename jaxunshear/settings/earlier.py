"""Settings that came, or went, after others had been stored: for all that reads or compares stored settings.

A setting that is added does nothing at the value given here. So a file that lacks it is read as if that value stood in it, and the
names of data sets, of rows and of trainings leave it out at that value: what was made before is found again.
"""

from jaxunshear.storage import Json

LATER: Json = {
    "poses_a_slide": 1,
    "twist_deg": 0.0,
    "tilt_deg": 0.0,
    "other_twists_deg": (),
    "other_tilts_deg": (),
    "apart": False,
    "convolved": (),
    "direct_convolved": (),
    "direct_taps": "none",
    "swap_weight": 0.0,
    "agreement_weight": 0.0,
    "slide_weight": 0.0,
    "paired_share": 1.0,
    "tap_weight": 0.0,
    "alike_weight": 0.0,
    "split": "random",
}

GONE: Json = {  # files may still have these settings, which do nothing at these values
    "shear_noise": 0.0,
    "residual": 0,
    "both_sides": False,
    "mirror": False,
    "hidden_pins": 0.0,
    "label_weight": 0.0,
}

MOVED = {  # modules that experiment files imported
    "jaxunshear.experiment": "jaxunshear.settings.experiment",
    "jaxunshear.config": "jaxunshear.settings.load",
    "jaxunshear.scene.sensor": "jaxunshear.settings.sensor",
    "jaxunshear.image.settings": "jaxunshear.settings.image",
    "jaxunshear.dataset.settings": "jaxunshear.settings.data",
    "jaxunshear.dataset.configs": "jaxunshear.settings.configs",
    "jaxunshear.model.settings": "jaxunshear.settings.networks",
    "jaxunshear.training.settings": "jaxunshear.settings.training",
    "jaxunshear.sweep.settings": "jaxunshear.settings.sweep",
}


def is_later(name: str, value: object) -> bool:
    """Whether a stored file may lack the setting of this dotted name, which has `value` today; or may have it, where today has none."""
    last, known = name.rpartition(".")[2], LATER | GONE
    return last in known and known[last] == (tuple(value) if isinstance(value, list) else value)


def without_later(fields: Json) -> Json:
    """Nested settings without what is LATER, or GONE, and does nothing."""
    kept = {name: value for name, value in fields.items() if not is_later(name, value)}
    return {name: without_later(value) if isinstance(value, dict) else value for name, value in kept.items()}
