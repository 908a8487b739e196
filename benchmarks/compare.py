"""Time of comparisons: two long datasets, and many short ones, with their rates beside it."""

import time

import numpy as np

from errormotion import datasets
from errormotion.compare import compare

START = "2026-03-01T08:00:00+00:00"


def made(size: int, sources: int, rng: np.random.Generator, truth: np.ndarray) -> object:
    """Return an error dataset over time with noise and sources, drawn from its own covariance."""
    F = rng.normal(0, 1e-7, (sources, 1, 6)) * np.linspace(0, 1, size)[None, :, None]
    noise = 1e-7
    values = truth + np.einsum("sti,s->ti", F, rng.normal(size=sources)) + noise * rng.normal(size=(size, 6))
    covariance = noise**2 * np.eye(6) + np.einsum("sti,stj->tij", F, F, optimize=True)
    names = [f"source {k}" for k in range(sources)]
    return datasets.build_errors(
        values,
        covariance,
        dims=("time",),
        coords={"time": np.linspace(0.0, 7200.0, size)},
        influence=F,
        sources=names,
        source_groups=names,
        start=START,
        component="spindle",
        machine="benchmark",
        frame="machine",
        functional_point=(0, 0, 0),
        reference="cold",
        method="benchmark",
        method_version="1",
        provenance={},
    )


def main() -> None:
    rng = np.random.default_rng(0)
    for count, size, sources in ((2, 10_000, 30), (20, 200, 5)):
        t = np.linspace(0.0, 7200.0, size)[:, None]
        truth = 20e-6 * (1 - np.exp(-t / np.array([900.0, 1200, 1500, 1800, 2100, 2400])))
        found = {f"dataset {k}": made(size, sources, rng, truth) for k in range(count)}
        begin = time.perf_counter()
        result = compare(found, causes=False)
        seconds = time.perf_counter() - begin
        en = np.abs(result["en"].values)
        inside = np.mean(en[np.isfinite(en)] <= 1)
        print(
            f"{count} datasets of {size} instants with {sources} sources: {seconds:.2f} s; "
            f"{result.sizes['pair']} pairs, |En| <= 1 in {100 * inside:.1f} %, joint p {result.attrs['fit_p']:.2f}"
        )


if __name__ == "__main__":
    main()
