"""The energy that the machine's processors take, where its counters (Intel RAPL) can be read."""

from pathlib import Path

COUNTERS = Path("/sys/class/powercap")


class EnergyMeter:
    """Adds up what the processor packages have taken since it was made; it counts whatever else they worked on too.

    The counters wrap around after about an hour at full load: `sample` must be called more often than that.
    """

    def __init__(self, counters: Path = COUNTERS):
        self._packages = [p for p in sorted(counters.glob("intel-rapl:*")) if p.name.count(":") == 1]
        self._joules, self._last_uj = 0.0, self._read()

    def sample(self) -> float | None:
        """Return the energy so far, J; None where the machine does not tell, or not to this user."""
        now_uj = self._read()
        if now_uj is None or self._last_uj is None:
            return None
        for package, before_uj, after_uj in zip(self._packages, self._last_uj, now_uj, strict=True):
            if after_uj < before_uj:
                after_uj += int((package / "max_energy_range_uj").read_text())
            self._joules += (after_uj - before_uj) * 1e-6
        self._last_uj = now_uj
        return self._joules

    def _read(self) -> list[int] | None:
        try:
            return [int((package / "energy_uj").read_text()) for package in self._packages] or None
        except (OSError, ValueError):
            return None
