"""Outliers, and structural changes such as a ball that moved, by one rule with one rate of false alarms.

The gain of an error in a number, of a reading, or of a candidate is the decrease of the sum of squares if it is
estimated as well (`effects`). Without the error it has a chi-square distribution with k degrees of freedom; with an
unknown noise, ``(gain / k) / ((Q - gain) / (f - k))`` has an F distribution. For a single number the root of the gain
is Baarda's normalised residual w (Publ. Geodesy 2, 5, 1968); the F-test is that of Pope's tau (NOAA TR NOS 65
NGS 1, 1976) with the noise from the other readings.

Of all numbers and candidates, the most improbable one is excluded if its probability is below the rate of false alarms
over their number (Bonferroni), and the search is repeated. The effects of exclusions on other gains are exact for a
linear model, so that one fit serves several exclusions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.errors import FitError
from errormotion.estimation.additions import with_linear
from errormotion.estimation.blocks import Index
from errormotion.estimation.checks.candidates import Candidate
from errormotion.estimation.checks.effects import MIN_REDUNDANCY, At, Numbers, reduced, solved
from errormotion.estimation.checks.suspects import RIVAL, Sequence, Suspect
from errormotion.estimation.derivatives import column
from errormotion.estimation.fit import Fit, fit
from errormotion.estimation.problem import Problem, Unknown

__all__ = ["FALSE_ALARM", "Cleaned", "Exclusion", "cleaned", "doubts", "kept", "notes"]

FALSE_ALARM = 1e-3
"""Probability of excluding anything from valid data."""
MAX_PASSES = 60
SHOWN = 8
"""Exclusions that are named in a note."""
Flags = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Exclusion:
    """What was found.

    Attributes
    ----------
    words : str
    gain : float
        Decrease of the sum of squares.
    probability : float
        Probability of such a gain in any of the tests of valid data; 0 if it is below 1e-300.
    size : ndarray, (k,)
        The estimated gross error, in the unit of the residuals, or the unknowns of a candidate.
    readings : ndarray of bool, shape of the readings
        Those that are excluded, or in doubt if it is undecided.
    rivals : tuple of str
        Other explanations that are hardly less probable. They are excluded as well if the remaining readings determine
        all unknowns; if not, nothing is excluded.
    """

    words: str
    gain: float
    probability: float
    size: Array
    readings: Flags
    rivals: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Cleaned:
    """A fit without outliers.

    Attributes
    ----------
    fit : Fit
        Of the problem without what was excluded, and with the unknowns that were added.
    made : tuple of Exclusion
    undecided : tuple of Exclusion
        Contradictions that remain: what is wrong is not determined, or without it the unknowns would not be.
    unchecked : ndarray of bool, (n, m)
        Used numbers that no other reading checks.
    """

    fit: Fit
    made: tuple[Exclusion, ...]
    undecided: tuple[Exclusion, ...]
    unchecked: Flags

    @property
    def excluded(self) -> Flags:
        """All excluded readings, in the shape of the readings."""
        flags = np.zeros(self.fit.problem.readings.shape, dtype=bool)
        for exclusion in self.made:
            flags |= exclusion.readings
        return flags


def notes(search: Cleaned, what: str = "readings") -> list[str]:
    """Return a sentence on what was excluded; none for valid data."""
    texts = []
    if search.made:
        shown = [
            exclusion.words + "".join(f" or {other}" for other in exclusion.rivals) for exclusion in search.made[:SHOWN]
        ]
        more = f", and {len(search.made) - SHOWN} more" if len(search.made) > SHOWN else ""
        count = int(search.excluded.reshape(len(search.excluded), -1).any(axis=1).sum())
        done = f"{count} of them {'is' if count == 1 else 'are'} not used" if count else "their effect is estimated"
        texts.append(f"Some {what} contradict the others ({'; '.join(shown)}{more}); {done}.")
    return texts


def kept(search: Cleaned, what: str = "readings") -> list[str]:
    """Return a sentence on outliers that are used nevertheless, since the result is that of all readings."""
    listed = [*search.made, *search.undecided]
    if not listed:
        return []
    words = [exclusion.words + "".join(f" or {other}" for other in exclusion.rivals) for exclusion in listed[:SHOWN]]
    more = f", and {len(listed) - SHOWN} more" if len(listed) > SHOWN else ""
    return [
        f"Some {what} contradict the others ({'; '.join(words)}{more}); they are used, since the result is that of all "
        f"{what}. Correct them, or measure again."
    ]


def doubts(search: Cleaned, what: str = "readings") -> list[str]:
    """Return a sentence on each contradiction that remains, so that no uncertainty can be relied on."""
    texts = []
    for exclusion in search.undecided:
        if exclusion.rivals:
            texts.append(
                f"One of {', '.join([exclusion.words, *exclusion.rivals])} is wrong, and the other {what} do not show "
                "which; all are used. Measure them again, or add further ones."
            )
        else:
            texts.append(
                f"The {what} indicate: {exclusion.words}; they are used, since the others do not determine the result. "
                "Measure again."
            )
    return texts


def cleaned(
    problem: Problem,
    *,
    suspects: Callable[[Fit], Iterable[Candidate]] | None = None,
    whole: bool = False,
    false_alarm: float = FALSE_ALARM,
    name: Callable[[Index], str] | None = None,
    refresh: Callable[[Problem, Any], Problem] | None = None,
    structure: Callable[[Problem], Problem] | None = None,
    what: str = "the readings",
) -> Cleaned:
    """Fit a problem and exclude its outliers.

    Parameters
    ----------
    problem : Problem
    suspects : callable, optional
        Returns structural candidates for a fit; see `steps`.
    whole : bool
        Whether all numbers of a vector reading are wrong together. They are if the residuals are not one for each
        number of a reading.
    false_alarm : float
        Probability of excluding anything from valid data.
    name : callable, optional
        From the index of a number (reading, number), or of a reading (reading,), to its name in messages.
    structure : callable, optional
        From a problem without some readings to the one that is fitted: what depends on the readings that are used, such
        as the unknowns that they determine, and their index maps. A `FitError` means that they do not suffice.
    refresh, what
        See `fit`. With candidates that add unknowns, ``refresh`` must change the problem that it is given.

    Raises
    ------
    FitError
        As `fit`; or the search does not end.
    """
    search = _Search(problem, suspects, whole, false_alarm, name or _numbered, refresh, structure, what)
    return search.run()


@dataclass(frozen=True, eq=False)
class _Structure:
    """A candidate with its size, gain and number of determined unknowns."""

    candidate: Candidate
    size: Array
    gain: float
    k: int


@dataclass(eq=False)
class _Search:
    """One search; the state is what was found.

    A contradiction without a culprit is taken out of the search, as if its worst number were excluded.
    """

    problem: Problem
    suspects: Callable[[Fit], Iterable[Candidate]] | None
    whole: bool
    false_alarm: float
    name: Callable[[Index], str]
    refresh: Callable[[Problem, Any], Problem] | None
    structure: Callable[[Problem], Problem] | None
    what: str
    made: list[Exclusion] = field(default_factory=list)
    undecided: list[Exclusion] = field(default_factory=list)
    barred: set[str] = field(default_factory=set)

    def run(self) -> Cleaned:
        current = self.fitted(self.problem)
        self.whole = self.whole or current.linear.used.shape != column(self.problem.readings).shape
        open_ = np.zeros(self.problem.readings.shape, dtype=bool)
        for _ in range(MAX_PASSES):
            better, more = self.searched(current)
            open_ |= more
            if better is None:
                if open_.any():
                    readings = np.where(open_, self.problem.readings, current.problem.readings)
                    current = self.fitted(replace(current.problem, readings=readings), current)
                unchecked = current.linear.used & (Numbers(current, self.whole).redundancy <= MIN_REDUNDANCY)
                return Cleaned(current, tuple(self.made), tuple(self.undecided), unchecked)
            current = better
        raise FitError(
            f"more than {MAX_PASSES} searches for outliers among {self.what} have found more of them; check units, "
            "the order of the readings and their stated noise",
            code="estimation.outliers.too_many",
        )

    def fitted(self, problem: Problem, before: Fit | None = None) -> Fit:
        """Return the fit of a problem, from the solution of one with the same unknowns or one table less."""
        start = None
        if self.structure is not None:
            problem = self.structure(problem)
        if before is not None:
            more = [block.start for block in problem.unknowns[len(before.problem.unknowns) :]]
            start = Unknown([*before.linear.at.tables, *more], before.linear.at.adjusted)
        return fit(problem, refresh=None if self.refresh is None else self._refreshed, what=self.what, start=start)

    def _refreshed(self, problem: Problem, x: Any) -> Problem:
        """Return the refreshed problem; what is excluded stays excluded."""
        if self.refresh is None:
            return problem
        return replace(self.refresh(problem, x), readings=problem.readings)

    def searched(self, current: Fit) -> tuple[Fit | None, Flags]:
        """Return the fit after the most improbable exclusions, None if there are none; and what is undecided."""
        none = np.zeros(self.problem.readings.shape, dtype=bool)
        if current.freedom < 1:
            return None, none
        numbers = Numbers(current, self.whole)
        structures = self.structures(current)
        trials = int(numbers.tested.sum()) + sum(structure.candidate.trials for structure in structures)
        largest = max((structure.gain for structure in structures), default=0.0)
        search = Sequence(current, numbers, largest, float(np.log(self.false_alarm / max(trials, 1))))
        suspects, noise = search.suspects(), search.noise
        structures.sort(key=lambda structure: noise.chance(structure.gain, structure.k))
        if structures:
            chance = noise.chance(structures[0].gain, structures[0].k)
            if chance < search.limit:
                # What a single number explains as well is a single number: it excludes less.
                # Its gain is that of the number alone: several numbers, each given the others, are the change itself.
                alone = [noise.chance(float(numbers.gain[suspect.at]), numbers.k) for suspect in suspects]
                suspects = [suspect for suspect, own in zip(suspects, alone, strict=True) if own <= chance + RIVAL / 2]
                if not suspects:
                    return self.structured(current, structures, chance, trials, noise.unit), none
        return self.excluded(current, suspects, trials) if suspects else (None, none)

    def structures(self, current: Fit) -> list[_Structure]:
        """Return the candidates with their effects."""
        listed = []
        for candidate in () if self.suspects is None else self.suspects(current):
            J = candidate.design[:, None, :] if candidate.design.ndim == 2 else candidate.design
            rows = np.flatnonzero(J.any(axis=(1, 2)))
            white = current.linear.whitener[rows] @ J[rows]
            size, gain, rank = solved(*reduced(current, white, rows), 1e-6 * float(np.vdot(white, white)))
            if rank and np.linalg.norm(size) >= candidate.smallest and candidate.words not in self.barred:
                listed.append(_Structure(candidate, size, float(gain), int(rank)))
        return listed

    def excluded(self, current: Fit, suspects: list[Suspect], trials: int) -> tuple[Fit, Flags]:
        """Return the fit without these numbers, and those of them that are undecided."""
        wrong = np.zeros(self.problem.readings.shape, dtype=bool)
        open_ = wrong.copy()
        for suspect in suspects:
            out = self.flags(suspect.at)
            for at in suspect.rivals:
                out |= self.flags(at)
            one = Exclusion(
                words=self.words(suspect.at),
                gain=suspect.gain,
                probability=_probability(suspect.chance, trials),
                size=suspect.size,
                readings=out,
                rivals=tuple(self.words(at) for at in suspect.rivals),
            )
            if suspect.rivals and not self.possible(current, wrong | out):
                self.undecided.append(one)
                open_ |= self.flags(suspect.at)
            else:
                self.made.append(one)
                wrong |= out
        return self.fitted(current.problem.without(wrong | open_), current), open_

    def structured(self, current: Fit, structures: list[_Structure], chance: float, trials: int, unit: float) -> Fit:
        """Return the fit without the readings of the best candidate, or with its unknowns."""
        best = structures[0]
        candidate = best.candidate
        out = np.zeros(self.problem.readings.shape, dtype=bool)
        if candidate.excluded is not None:
            out |= candidate.excluded.reshape(-1, *[1] * (out.ndim - 1))
        one = Exclusion(
            words=candidate.words,
            gain=best.gain,
            probability=_probability(chance, trials),
            size=best.size,
            readings=out,
            rivals=tuple(each.candidate.words for each in structures[1:] if each.gain > best.gain - RIVAL * unit),
        )
        if candidate.excluded is None:
            problem = with_linear(current.problem, f"added_{len(self.made) + 1}", candidate.design, group=one.words)
        else:
            problem = current.problem.without(out)
        self.barred.add(candidate.words)
        try:
            better = self.fitted(problem, current)
        except FitError:
            self.undecided.append(one)
            return current
        self.made.append(one)
        return better

    def flags(self, at: At) -> Flags:
        """Return the readings that are excluded with a number."""
        flags = np.zeros(self.problem.readings.shape, dtype=bool)
        flags[at[:1] if self.whole or flags.ndim == 1 else at] = True
        return flags

    def words(self, at: At) -> str:
        """Return the name of a number."""
        return self.name(np.array(at[:1] if self.whole or self.problem.readings.ndim == 1 else at))

    def possible(self, current: Fit, wrong: Flags) -> bool:
        """Return whether the readings without ``wrong`` determine all unknowns."""
        try:
            self.fitted(current.problem.without(wrong), current)
        except FitError:
            return False
        return True


def _probability(chance: float, trials: int) -> float:
    """Return the probability of a chance in any of several tests, from its logarithm for one."""
    return float(np.exp(min(chance + np.log(trials), 0.0)))


def _numbered(at: Index) -> str:
    return f"reading {at[0] + 1}" if at.size == 1 else f"number {at[1] + 1} of reading {at[0] + 1}"
