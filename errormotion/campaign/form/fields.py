"""The fields of a campaign: one for each key that its tables and the settings of its methods may have.

A form is made from the text of a campaign only: a changed field changes the text, and the form of the new text is
shown. Text and form therefore always agree.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from errormotion import plugins
from errormotion.campaign.files import CampaignPlan, CampaignTable, MistakesError, TestTable, campaign_of
from errormotion.campaign.form.written import default_of, has_default, quantity_of
from errormotion.datasets.files.tomlfile import Key, dotted, options_of, parse_toml
from errormotion.datasets.files.tomltext import value, value_of, with_table, with_value, without_table
from errormotion.errors import BenchError, DatasetError, PluginError

MAX_DEPTH = 3
"""Number of levels of tables whose keys become separate fields."""
_CAMPAIGN = ("name", "bench", "operator")
_TEST = ("name", "method", "at", "inputs", "instruments", "monte_carlo")


@dataclass(frozen=True)
class Field:
    """One key of a campaign.

    Attributes
    ----------
    place : tuple of str or int
        Keys from the top of the file.
    label, meaning : str
    unit : str
        Example of a quantity with its unit, such as ``5 mm``; empty if the value has no unit.
    default : str
        Value if the key is not stated; empty if there is none.
    text : str
        Value in the file, as text of a field; empty if the key is not stated.
    choices : tuple of str
        Allowed values; empty if any value is allowed.
    plain : bool
        Whether the value is a TOML string, not a number, an array or a table.
    mistakes : tuple of str
    """

    place: tuple[Key, ...]
    label: str
    meaning: str
    unit: str
    default: str
    text: str
    choices: tuple[str, ...]
    plain: bool
    required: bool
    mistakes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Group:
    """Fields of one table, the mistakes that belong to none of them, and the number of its test from 0."""

    title: str
    fields: tuple[Field, ...]
    mistakes: tuple[str, ...] = ()
    test: int | None = None


@dataclass(frozen=True)
class Form:
    """A campaign as a form; ``plan`` is None while there are mistakes, of which ``mistakes`` belong to no group."""

    text: str
    groups: tuple[Group, ...]
    mistakes: tuple[str, ...]
    plan: CampaignPlan | None

    @property
    def count(self) -> int:
        """Number of mistakes."""
        inside = sum(len(group.mistakes) + sum(len(each.mistakes) for each in group.fields) for group in self.groups)
        return len(self.mistakes) + inside


def form_of(text: str, source: Path) -> Form:
    """Return the form of the text of a campaign; ``source`` is the path of its file."""
    try:
        data = parse_toml(text, source.name, error=BenchError)
    except BenchError as error:
        return Form(text, (), (str(error),), None)
    plan, mistakes, general = _checked(text, source)
    groups = []
    for title, place, fields in _groups(data):
        own, rest = [], list[str]()
        for each in fields:
            here, mistakes = _split(mistakes, each.place)
            own.append(Field(**{**each.__dict__, "mistakes": tuple(here)}))
        if place:
            rest, mistakes = _split(mistakes, place, whole=True)
        groups.append(Group(title, tuple(own), tuple(rest), test=int(place[1]) if place else None))
    return Form(text, tuple(groups), (*general, *mistakes), plan)


def with_field(text: str, place: Sequence[Key], written: str) -> str:
    """Return the text of a campaign with a changed field; an empty field removes its key.

    Raises
    ------
    DatasetError
        The field does not exist, or the text states it in a form that cannot be changed separately.
    """
    data = parse_toml(text, "text")
    known = {each.place: each for _, _, fields in _groups(data) for each in fields}
    field = known.get(tuple(place))
    if field is None:
        raise DatasetError(f"{dotted(place)}: no such field", code="form.field.unknown")
    if written.strip() == "" and not (field.required and field.plain):
        return with_value(text, place, None)
    return with_value(text, place, written if field.plain else value_of(written.strip()))


def with_test(text: str) -> str:
    """Return the text of a campaign with one more test, without a method.

    Raises
    ------
    DatasetError
        The text states its tests in a form to which no test can be added.
    """
    tests = parse_toml(text, "text").get("test")
    names = {test.get("name") for test in tests if isinstance(test, dict)} if isinstance(tests, list) else set()
    name = next(each for number in count(len(names) + 1) if (each := f"test-{number}") not in names)
    return with_table(text, "test", {"name": name, "method": ""})


def without_test(text: str, number: int) -> str:
    """Return the text of a campaign without one of its tests, counted from 0.

    Raises
    ------
    DatasetError
        The test does not exist, or the text states it in a form that cannot be removed separately.
    """
    return without_table(text, "test", number)


def _checked(text: str, source: Path) -> tuple[CampaignPlan | None, list[str], list[str]]:
    """Return the plan, the mistakes that start with a key of this file, and the others."""
    try:
        return campaign_of(text, source), [], []
    except MistakesError as error:
        if error.source != source:  # mistakes of the bench file only
            return None, [], [str(error)]
        return None, list(error.mistakes), [error.more] if error.more else []
    except BenchError as error:
        return None, [], [str(error)]


def _split(mistakes: Sequence[str], place: Sequence[Key], *, whole: bool = False) -> tuple[list[str], list[str]]:
    """Return the mistakes at a key or below it, without the key, and the others; ``whole``: with their keys."""
    key = dotted(place)
    here, others = [], []
    for each in mistakes:
        found, sign, text = each.partition(": ")
        if not sign or not (found == key or found.startswith((f"{key}.", f"{key}["))):
            others.append(each)
        elif whole:
            here.append(each)
        else:
            here.append(text if found == key else f"{found[len(key) :].lstrip('.')}: {text}")
    return here, others


def _groups(data: Mapping[str, Any]) -> Iterator[tuple[str, tuple[Key, ...], list[Field]]]:
    yield "Campaign", (), list(_fields(CampaignTable, (), data, _CAMPAIGN))
    tests = data.get("test")
    for number, test in enumerate(tests if isinstance(tests, list) else []):
        if not isinstance(test, dict):
            continue
        place = ("test", number)
        fields = list(_fields(TestTable, place, test, _TEST))
        settings = test.get("settings", {})
        try:
            model = plugins.get("methods", str(test.get("method"))).Settings
        except PluginError:
            model = None
        if model is not None and isinstance(settings, dict):
            fields += _fields(model, (*place, "settings"), settings)
        yield f"Test {number + 1}: {test.get('name', '')}", place, fields


def _fields(
    model: type[BaseModel], place: tuple[Key, ...], data: Mapping[str, Any], names: Sequence[str] = (), label: str = ""
) -> Iterator[Field]:
    for name, field in model.model_fields.items():
        if names and name not in names:
            continue
        key = field.alias or name
        stated = data.get(key)
        inner = _table(field)
        if inner is not None and len(label.split(".")) < MAX_DEPTH and (stated is None or isinstance(stated, dict)):
            yield from _fields(inner, (*place, key), stated or {}, label=f"{label}{key}.")
        else:
            yield _field(field, (*place, key), f"{label}{key}", stated)


def _field(field: FieldInfo, place: tuple[Key, ...], label: str, stated: Any) -> Field:
    options = [each for each in options_of(field.annotation) if each is not type(None)]
    quantity = quantity_of(field)
    choices = _choices(options)
    single = all(option in (str, Path) or get_origin(option) is Literal for option in options)
    plain = single or (quantity is not None and options == [float])
    if place[-1] == "method":
        choices, plain = tuple(each.id for each in plugins.available("methods") if each.cls is not None), True
    written = "" if stated is None else stated if plain and isinstance(stated, str) else value(stated)
    if written and choices and written not in choices:  # an invalid value is shown as well
        choices = (*choices, written)
    return Field(
        place=place,
        label=label,
        meaning=str(field.description or ""),
        unit="" if quantity is None else quantity.example,
        default=default_of(field) if has_default(field) else "",
        text=written,
        choices=choices,
        plain=plain,
        required=field.is_required(),
    )


def _choices(options: Sequence[Any]) -> tuple[str, ...]:
    if options == [bool]:
        return ("true", "false")
    if options and all(get_origin(option) is Literal for option in options):
        choices = tuple(each for option in options for each in get_args(option))
        return choices if all(isinstance(each, str) for each in choices) else ()
    return ()


def _table(field: FieldInfo) -> type[BaseModel] | None:
    """Return the model of a field that is always a table; None for other fields."""
    options = options_of(field.annotation)
    only = options[0] if len(options) == 1 else None
    return only if isinstance(only, type) and issubclass(only, BaseModel) else None
