"""Where the fingers are in a touched frame. Front door of the room."""

from __future__ import annotations

from touchd.config.schema import Settings
from touchd.keypad import Layout
from touchd.localization.atlas_localizer import AtlasLocalizer
from touchd.localization.localization import Localizer
from touchd.localization.model import Model
from touchd.localization.network_localizer import NetworkLocalizer
from touchd.localization.uncalibrated import Uncalibrated


def make_localizer(model: Model | None, settings: Settings, layout: Layout | None) -> Localizer:
    """Return what places fingers with a model: its field atlas if it was loaded with one, else its network.

    Without a model nothing is placed.
    """
    if model is None:
        return Uncalibrated()
    if model.atlas is None:
        return NetworkLocalizer(model, settings, layout)
    return AtlasLocalizer(model, model.atlas, settings, layout)
