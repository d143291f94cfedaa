"""The errors of the flight software. The sequencer catches FlightError, counts it and goes on."""

from obbgs_base.errors import ObbgsError


class FlightError(ObbgsError):
    """The world misbehaved: a camera, an orbit, a disk or a link."""


class OrbitError(FlightError):
    """The orbital elements cannot be propagated to the requested time."""


class CaptureError(FlightError):
    """The camera did not deliver the exposure it was asked for."""


class CameraLost(CaptureError):
    """The camera does not answer any more; it may come back."""


class StoreError(FlightError):
    """The frame store cannot be read or written."""


class StoreFull(StoreError):
    """The quota or the disk is full, and the policy allows nothing to be deleted."""


class NavigationError(FlightError):
    """The navigation stream cannot be opened, or has no usable state for the requested time."""


class DownlinkError(FlightError):
    """The downlink failed several times in a row with errors that are not ours."""


class TriageError(FlightError):
    """A model or a frame cannot be used for triage."""


class TriageMissing(TriageError):
    """Triage needs onnxruntime, an extra of the package, which is not installed."""

    exit_code = 2
