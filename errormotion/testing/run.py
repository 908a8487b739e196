"""Run the kit on a plugin of the registry."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from difflib import get_close_matches
from typing import Any

from errormotion import plugins
from errormotion.errors import PluginError
from errormotion.plugins import CompensatorSubject, Group, InstrumentSubject, MethodSubject, load_object
from errormotion.testing.kit import Check, CheckResult, run_check

SIMULATED = "sim://cframe?seed=3"

Subject = InstrumentSubject | MethodSubject | CompensatorSubject
_EXPECTED = {
    "instruments": "InstrumentSubject",
    "methods": "MethodSubject",
    "compensators": "CompensatorSubject",
}


def check_plugin(
    group: Group,
    plugin_id: str,
    *,
    address: str | None = None,
    mutants: int | None = None,
    only: Sequence[str] = (),
) -> list[CheckResult]:
    """Run the checks on one plugin of the registry.

    Parameters
    ----------
    group : "instruments", "methods" or "compensators"
    plugin_id : str
    address : str, optional
        Address of the instrument or the machine; default: that of its simulator.
    mutants : int, optional
        Number of changed frames for a driver; default: as its subject states.
    only : sequence of str
        Names of the checks to be run; empty: all.

    Returns
    -------
    list of CheckResult
        In the order of the checks; with several subjects, with the name of the subject in brackets.

    Raises
    ------
    PluginError
        The id is unknown, or the plugin cannot be loaded or states no subject; or there is no check of a name.
    """
    results = []
    for subject in subjects_of(group, plugin_id, address=address):
        if mutants is not None and isinstance(subject, InstrumentSubject | CompensatorSubject):
            subject = replace(subject, mutants=mutants)
        for result in run_checks(subject, only):
            results.append(replace(result, name=f"{result.name}[{subject.name}]") if subject.name else result)
    return results


def run_checks(subject: Subject, only: Sequence[str] = ()) -> list[CheckResult]:
    """Run the checks of the kit on one subject: those of the names ``only``, or all.

    Raises
    ------
    PluginError
        There is no check of a name for such a subject.
    """
    checks = checks_for(subject)
    names = [check.name for check in checks]
    for name in only:
        if name not in names:
            near = get_close_matches(name, names, n=1)
            hint = f". Did you mean '{near[0]}'?" if near else ""
            raise PluginError(
                f"There is no check '{name}'; expected one of {', '.join(names)}{hint}", code="check.unknown"
            )
    return [run_check(check, subject) for check in checks if not only or check.name in only]


def checks_for(subject: Subject) -> Sequence[Check[Any]]:
    """Return the checks for a subject of this kind, in their order."""
    if isinstance(subject, InstrumentSubject):
        from errormotion.testing.checks.instrument import INSTRUMENT_CHECKS

        return INSTRUMENT_CHECKS
    if isinstance(subject, CompensatorSubject):
        from errormotion.testing.checks.compensator import COMPENSATOR_CHECKS

        return COMPENSATOR_CHECKS
    from errormotion.testing.checks.method import METHOD_CHECKS

    return METHOD_CHECKS


def _maker(cls: Any) -> Callable[[], Any]:
    """Return the function that makes the subjects, a static one or that of an instance."""
    found: Callable[[], Any] = (cls() if issubclass(cls, plugins.Method) else cls).conformance
    return found


def subjects_of(group: Group, plugin_id: str, *, address: str | None = None) -> Sequence[Subject]:
    """Return the subjects of one plugin.

    A plugin states its subjects by the attribute ``conformance``: a function that returns one subject or a tuple of
    them, or the text ``module:name`` of such subjects. An instrument or a compensator without it is examined at
    ``sim://`` (or at ``address``) with its default settings.

    Raises
    ------
    PluginError
        The plugin states no subject, and there is no default.
    """
    cls = plugins.get(group, plugin_id)
    subjects: tuple[Any, ...] = ()
    if plugins.states(cls, "conformance") if group == "methods" else hasattr(cls, "conformance"):
        stated = load_object(cls.conformance) if isinstance(cls.conformance, str) else _maker(cls)()
        subjects = stated if isinstance(stated, tuple) else (stated,)
        if not all(isinstance(subject, Subject) for subject in subjects):
            raise PluginError(
                f"The attribute conformance of '{plugin_id}': expected {_EXPECTED.get(group, 'subject')}",
                code="check.conformance.form",
            )
    if not subjects and group == "methods":
        raise PluginError(
            f"The method '{plugin_id}' states no subject for the checks; expected an attribute conformance = "
            "'module:name' of its class, with a MethodSubject.",
            code="check.subject.missing",
        )
    if not subjects:
        if group == "datasets":
            raise PluginError(
                f"'{plugin_id}' is a kind of dataset; the kit has no checks for these.", code="check.kind.none"
            )
        if address is None and not cls.info.simulator:
            raise PluginError(
                f"The {group.rstrip('s')} '{plugin_id}' has no simulator; give the address of a real one.",
                code="check.simulator.missing",
            )
        subjects = (CompensatorSubject(cls) if group == "compensators" else InstrumentSubject(cls, SIMULATED),)
    return subjects if address is None else tuple(replace(subject, address=address) for subject in subjects)
