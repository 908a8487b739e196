"""The errors of a volume in space: vectors at a functional point, unknown targets counted, drawn in the browser."""

import html
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

pytest.importorskip("bokeh", reason="pip install 'errormotion[dashboard]'")

from coded import raises

from errormotion import datasets
from errormotion.campaign.folder import RunFolder
from errormotion.dashboard.space import drawing, has_volume
from errormotion.datasets import provenance
from errormotion.datasets.results.build import build_errors


@pytest.fixture(scope="module")
def volume() -> xr.Dataset:
    """A volume of 27 targets, scaled along X by 10 um/m and rotated by 1 urad about Y; one is unknown."""
    grid = np.stack(np.meshgrid(*[np.linspace(0.0, 0.4, 3)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    twist = np.zeros((27, 6))
    twist[:, 0], twist[:, 4] = 10e-6 * grid[:, 0], 1e-6
    twist[5] = np.nan
    covariance = np.broadcast_to(np.diag([1e-7] * 3 + [1e-7] * 3) ** 2, (27, 6, 6)).copy()
    coords = {axis: ("target", grid[:, k], {"units": "m"}) for k, axis in enumerate("xyz")}
    return build_errors(
        twist, covariance, dims=("target",), coords={"target": [f"P{k} <b>" for k in range(27)], **coords},
        machine="Mill", component="tool", frame="machine", functional_point=np.zeros(3), method="multilateration",
        method_version="1", reference="first target", provenance=provenance.make({}, None, None),
        start="2026-01-01T08:00:00+00:00",
    )  # fmt: skip


def _lines(found: Any) -> Any:
    """Return the ends of all arrows that were drawn, (n, 2, 3), m."""
    scene = json.loads(html.unescape(re.search(r'data-scene="([^"]*)"', str(found.markup)).group(1)))  # type: ignore[union-attr]
    return np.concatenate([np.array(part["ends"]) for part in scene["parts"] if part.get("head")])


def test_arrows_are_the_errors_at_the_functional_point(volume: xr.Dataset) -> None:
    found = drawing(volume)
    factor = int(re.search(r"enlarged (\d+) times", found.caption).group(1))  # type: ignore[union-attr]
    ends = _lines(found)
    known = np.isfinite(volume["EX"].values)
    assert len(ends) == known.sum() == 26
    assert np.sort((ends[:, 1] - ends[:, 0])[:, 0] / factor) == pytest.approx(
        np.sort(volume["EX"].values[known]), abs=1e-8
    )
    assert "the longest is 4.00 µm" in found.caption
    assert "1 targets are unknown" in found.caption
    assert "the longest is 3.90 µm" in drawing(volume, (0.0, 0.0, -0.1)).caption  # 1 urad times -0.1 m
    assert "<b>" not in str(found.markup)


def test_a_dataset_without_volume_is_an_error(volume: xr.Dataset) -> None:
    assert not has_volume(volume.drop_vars("x"))
    with raises("space.no_targets"):
        drawing(volume.drop_vars("x"))


@pytest.mark.slow
def test_a_volume_is_drawn_and_follows_the_functional_point(
    page: Any, accessible: Callable[[], None], serving: Callable[..., Any], volume: xr.Dataset, tmp_path: Path
) -> None:
    base = {"bench": {"machine": "Mill"}, "method": {"id": "multilateration"}, "steps": []}
    folder = RunFolder.create(tmp_path, "volume", "00000009", {**base, "status": "finished", "errors": "errors.nc"})
    datasets.save(volume, folder.path / "errors.nc")
    page.goto(f"{serving(tmp_path).address}run?run={folder.path.name}")
    frame = page.frame_locator("#space")
    frame.locator("canvas").wait_for()
    assert "4.00 µm" in frame.locator(".note").inner_text()
    page.wait_for_selector("#figure[data-drawn='1'] canvas")
    page.fill("input[name=z]", "-100")
    frame.locator(".note:has-text('3.90 µm')").wait_for()
    accessible()
