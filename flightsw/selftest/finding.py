"""One line of a self-test."""

from dataclasses import dataclass
from typing import Literal, Self


@dataclass(frozen=True)
class Finding:
    """What a check found, in a sentence, and what to do about it, empty where nothing has to be done."""

    check: str
    state: Literal["ok", "warning", "failed"]
    found: str
    advice: str = ""

    @classmethod
    def ok(cls, check: str, found: str) -> Self:
        return cls(check, "ok", found)

    @classmethod
    def warning(cls, check: str, found: str, advice: str) -> Self:
        return cls(check, "warning", found, advice)

    @classmethod
    def failed(cls, check: str, found: str, advice: str) -> Self:
        return cls(check, "failed", found, advice)
