"""What a run has to say against its own result: kind, first time, count and worst case."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class RunWarning:
    """One kind of trouble in a run, with one contact, joint or pair of bodies if it is about one.

    Attributes:
        kind: What it is, e.g. "energy gain".
        first: Time at which it was first seen [s].
        count: In how many steps it was seen.
        worst: Largest size, in the unit that `text` names.
        text: Sentence about the worst case, with a remedy.
        grave: Whether it may make the result wrong; a run with such a warning is not just
            "completed".
        about: Names of what it is about; empty for the whole scene.
    """

    kind: str
    first: float
    count: int
    worst: float
    text: str
    grave: bool
    about: tuple[str, ...] = ()


class RunWarnings(Mapping[str, RunWarning]):
    """The warnings of a run by their kind, in the order in which they first came.

    A kind gives the worst of its warnings; `every` has those about other pairs, too. Each is logged
    once, when it is first seen; the same on all ranks.

    Args:
        found: Those of the run that goes on.
    """

    def __init__(self, found: Iterable[RunWarning] = ()) -> None:
        self._found = {(w.kind, w.about): w for w in found}

    def __getitem__(self, kind: str) -> RunWarning:
        alike = [w for w in self._found.values() if w.kind == kind]
        if not alike:
            raise KeyError(kind)
        return max(alike, key=lambda w: w.worst)

    def __iter__(self) -> Iterator[str]:
        return iter(dict.fromkeys(kind for kind, _ in self._found))

    def __len__(self) -> int:
        return len(set(self))

    def __repr__(self) -> str:
        return repr(self.every)

    @property
    def every(self) -> list[RunWarning]:
        """All warnings, also those of one kind about different pairs."""
        return list(self._found.values())

    def add(
        self, kind: str, time: float, size: float, text: str, *, grave: bool,
        about: tuple[str, ...] = (), speak: bool = True,
    ) -> None:  # fmt: skip
        """Note a warning; every rank must make the same call.

        Args:
            kind: What it is.
            time: When [s].
            size: How bad; the largest is kept.
            text: Sentence with a remedy, kept with the largest size.
            grave: Whether the result may be wrong.
            about: Names of what it is about; each has a warning of its own.
            speak: Whether this rank logs the first warning of a kind about these.
        """
        old = self._found.get((kind, about))
        if old is None:
            if speak:
                logger.warning("t=%.6g: %s", time, text)
            self._found[kind, about] = RunWarning(kind, time, 1, size, text, grave, about)
            return
        worse = size > old.worst
        self._found[kind, about] = RunWarning(
            kind,
            old.first,
            old.count + 1,
            size if worse else old.worst,
            text if worse else old.text,
            old.grave or grave,
            about,
        )

    def withdraw(self, kinds: Iterable[str]) -> None:
        """Forget warnings of some kinds, of which the run now says what holds for all of it."""
        self._found = {key: w for key, w in self._found.items() if w.kind not in kinds}

    @property
    def grave(self) -> list[RunWarning]:
        """Warnings that may make the result wrong."""
        return [w for w in self._found.values() if w.grave]

    @property
    def lines(self) -> list[str]:
        """A line for each, for summaries and files."""
        return [
            f"warning, {w.kind}: {w.count} step{'s' if w.count > 1 else ''} from "
            f"t = {w.first:.6g}; {w.text}"
            for w in self._found.values()
        ]
