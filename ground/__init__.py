"""The ground station: from frames to models, and the sessions in which frames lie, for programs too.

The names in `__all__` can be imported from `ground`; their modules are imported when they are first used.
"""

from obbgs_base.imports import lazily

_MODULES = {  # public name: the module that defines it
    "frames_of": "session.training_frames",
    "open_session": "session.folder",
    "predicted_image": "session.cameras",
    "sensor_of": "session.cameras",
    "split": "session.training_frames",
}
__all__ = list(_MODULES)  # pyright: ignore[reportUnsupportedDunderAll]
__getattr__ = lazily(__name__, _MODULES)
