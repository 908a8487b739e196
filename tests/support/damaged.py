"""Damaged datasets and JSON: seeded changes of content that a reader may not trust.

`dataset` changes variables, dims, coordinates and attributes; `json_of` changes values and keys at any depth. Bytes are
damaged by `mutants`. Every result follows from its number alone.
"""

import json
import random
from collections.abc import Callable
from typing import Any

import numpy as np
import xarray as xr

SCALARS: tuple[Any, ...] = (
    *("", "text", "nan", "../../etc/passwd", "<script>alert(1)</script>", "\0", "9" * 400, "[[[[", "{}", "null"),
    *(0, -1, 1, 2**31, 2**63, 10**18, -0.0, 1e308, -1e308, 5e-324, float("nan"), float("inf"), float("-inf")),
    *(True, False),
)
"""What replaces a value."""
OBJECTS: tuple[Any, ...] = (None, [], {}, [None], [[]], {"": ""}, {"a": {"b": [1]}})
UNITS = ("mdegC", "5 mm-1", "nan", "m^99", "m^-99", "", "%", "m/0", "furlong", "9" * 300, "µm", "K", "1/min", "m" * 99)


def dataset(ds: xr.Dataset, number: int) -> xr.Dataset:
    """Return a copy of a dataset with one to three changes."""
    rng = random.Random(number)
    found = ds.copy(deep=True)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        for _ in range(20):
            try:
                found = rng.choice(CHANGES)(found, rng)
            except (ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError):
                continue  # impossible on this dataset: another change
            break
    return found


def _name(ds: xr.Dataset, rng: random.Random) -> str:
    return rng.choice(sorted(map(str, ds.variables)))


def drop_variable(ds: xr.Dataset, rng: random.Random) -> xr.Dataset:
    """Take out a variable or a coordinate."""
    return ds.drop_vars(_name(ds, rng))


def rename_dim(ds: xr.Dataset, rng: random.Random) -> xr.Dataset:
    """Rename a dim, to a new name."""
    dim = rng.choice(sorted(map(str, ds.dims)))
    return ds.rename_dims({dim: rng.choice(("other", "time_", "x" * 200))})


def select(ds: xr.Dataset, rng: random.Random) -> xr.Dataset:
    """Reduce a dim to nothing, one element, or another order; or take one element out of it."""
    dim = rng.choice(sorted(map(str, ds.dims)))
    size = ds.sizes[dim]
    return ds.isel(
        {dim: rng.choice((slice(0, 0), slice(0, 1), slice(None, None, -1), slice(1, None), rng.randrange(size)))}
    )


def repeat(ds: xr.Dataset, rng: random.Random) -> xr.Dataset:
    """Repeat the elements of a dim."""
    dim = rng.choice(sorted(map(str, ds.dims)))
    return ds.isel({dim: np.repeat(np.arange(ds.sizes[dim]), 2)})


def transpose(ds: xr.Dataset, rng: random.Random) -> xr.Dataset:
    """Reverse the dims of a variable."""
    name = _name(ds, rng)
    return ds.assign({name: ds[name].transpose(*reversed(ds[name].dims))})


def squeeze(ds: xr.Dataset, rng: random.Random) -> xr.Dataset:
    """Replace a variable by its first element, without dims."""
    name = _name(ds, rng)
    return ds.drop_vars(name).assign({name: ((), ds[name].values.ravel()[0], ds[name].attrs)})


def retype(ds: xr.Dataset, rng: random.Random) -> xr.Dataset:
    """Change the type of a variable."""
    name = _name(ds, rng)
    values = ds[name].values
    kind = rng.choice(("text", "float32", "int64", "bool", "complex", "int8", "datetime"))
    if kind == "text":
        changed: Any = values.astype(str).astype(object)
    elif kind == "datetime":
        changed = np.zeros(values.shape, "datetime64[ns]")
    else:
        with np.errstate(all="ignore"):
            changed = np.nan_to_num(values.astype(float)).astype(kind)
    return ds.drop_vars(name).assign({name: (ds[name].dims, changed, ds[name].attrs)})


def revalue(ds: xr.Dataset, rng: random.Random) -> xr.Dataset:
    """Replace one element of a variable, or all of them, by an unusual number."""
    name = _name(ds, rng)
    values = ds[name].values.copy()
    number = rng.choice([each for each in SCALARS if isinstance(each, (int, float))])
    if values.dtype.kind not in "fiu" or rng.random() < 0.2:
        values = values.astype(object)
        values[...] = str(rng.choice(SCALARS))
        values = values.astype(str).astype(object)
    elif rng.random() < 0.5:
        values.reshape(-1)[rng.randrange(values.size)] = number
    else:
        values[...] = number
    return ds.drop_vars(name).assign({name: (ds[name].dims, values, ds[name].attrs)})


def scale(ds: xr.Dataset, rng: random.Random) -> xr.Dataset:
    """Multiply a variable by an unusual factor."""
    name = _name(ds, rng)
    with np.errstate(all="ignore"):
        return ds.assign({name: ds[name] * rng.choice((0.0, -1.0, 1e30, 1e-30, 1e200))})


def change_attribute(ds: xr.Dataset, rng: random.Random) -> xr.Dataset:
    """Change or remove an attribute of the dataset."""
    return ds.assign_attrs() if not ds.attrs else _with(ds, _attributes(dict(ds.attrs), rng))


def _with(ds: xr.Dataset, attrs: dict[Any, Any]) -> xr.Dataset:
    found = ds.copy()
    found.attrs = attrs
    return found


def change_variable_attribute(ds: xr.Dataset, rng: random.Random) -> xr.Dataset:
    """Change or remove an attribute of a variable, most often its unit."""
    name = _name(ds, rng)
    found = ds.copy()
    if rng.random() < 0.6:
        found[name].attrs["units"] = rng.choice(UNITS)
    else:
        found[name].attrs = _attributes(dict(found[name].attrs), rng)
    return found


def _attributes(attrs: dict[Any, Any], rng: random.Random) -> dict[Any, Any]:
    name = rng.choice(sorted(attrs))
    kind = rng.random()
    if kind < 0.25:
        del attrs[name]
    elif kind < 0.5 and isinstance(attrs[name], str) and attrs[name][:1] in "[{":
        attrs[name] = json.dumps(json_of(json.loads(attrs[name]), rng.randrange(10**6)))
    elif kind < 0.6:
        attrs[name] = np.array([rng.choice((0.0, 1e308, float("nan")))] * rng.choice((1, 2, 3, 40)))
    else:
        value = rng.choice(SCALARS)
        attrs[name] = (int(value) if isinstance(value, bool) else float(value)) if not isinstance(value, str) else (
            value.replace("\0", "")
        )  # fmt: skip
    return attrs


def add(ds: xr.Dataset, rng: random.Random) -> xr.Dataset:
    """Add a variable that nobody expects."""
    name = rng.choice(("extra", "x" * 300, "sample", "covariance_", "..", "a b"))
    return ds.assign({name: ((), rng.choice((1.0, "text")))})


CHANGES: tuple[Callable[[xr.Dataset, random.Random], xr.Dataset], ...] = (
    drop_variable, rename_dim, select, select, repeat, transpose, squeeze, retype, revalue, revalue, scale,
    change_attribute, change_attribute, change_attribute, change_variable_attribute, change_variable_attribute, add,
)  # fmt: skip


def json_of(content: Any, number: int) -> Any:
    """Return a copy of what JSON describes with one value or key changed, at any depth."""
    rng = random.Random(number)
    found = json.loads(json.dumps(content))
    at, key, holder = found, None, None
    while isinstance(at, (dict, list)) and at and (key is None or rng.random() < 0.75):
        holder, key = at, rng.choice(sorted(at)) if isinstance(at, dict) else rng.randrange(len(at))
        at = holder[key]
    if holder is None:
        return rng.choice((*SCALARS, *OBJECTS))
    kind = rng.random()
    if kind < 0.2:
        del holder[key]
    elif kind < 0.3 and isinstance(holder, dict):
        holder[str(rng.choice(SCALARS))] = holder.pop(key)
    else:
        holder[key] = rng.choice((*SCALARS, *OBJECTS))
    return found
