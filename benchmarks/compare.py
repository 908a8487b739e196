"""Time of comparisons of two long datasets and of many short ones, their rates of agreement, and the time of causes."""

import time
import tracemalloc

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


def memory(size: int, sources: int) -> float:
    """Return the largest memory that a comparison of two datasets allocates, MB."""
    found = warm_ups(2, size, sources)
    tracemalloc.start()
    compare(found, causes=False)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak / 1e6


def warm_ups(count: int, size: int, sources: int) -> dict[str, object]:
    """Return datasets of one warm-up."""
    rng = np.random.default_rng(0)
    t = np.linspace(0.0, 7200.0, size)[:, None]
    truth = 20e-6 * (1 - np.exp(-t / np.array([900.0, 1200, 1500, 1800, 2100, 2400])))
    return {f"dataset {k}": made(size, sources, rng, truth) for k in range(count)}


def main() -> None:
    for count, size, sources, uses in ((2, 10_000, 30, 2), (20, 200, 5, 1), (1000, 200, 5, 1)):
        found = warm_ups(count, size, sources)
        for use in range(uses):
            begin, cpu = time.perf_counter(), time.process_time()
            result = compare(found, causes=False)
            seconds, cpu = time.perf_counter() - begin, time.process_time() - cpu
            en = np.abs(result["en"].values)
            print(
                f"{count} datasets of {size} instants with {sources} sources{', again' if use else ''}: "
                f"{seconds:.2f} s ({cpu:.2f} s of processor time); {result.sizes['pair']} pairs, |En| <= 1 in "
                f"{100 * np.mean(en[np.isfinite(en)] <= 1):.1f} %, joint p {result.attrs['fit_p']:.2f}"
            )
    for size in (300, 3000):
        found = warm_ups(2, size, 5)
        found["dataset 1"] = found["dataset 1"].assign_attrs(functional_point=np.array([0.05, 0.1, -0.1]))
        begin, cpu = time.perf_counter(), time.process_time()
        named = compare(found)["cause"].values[0, 0]
        seconds, cpu = time.perf_counter() - begin, time.process_time() - cpu
        print(f"causes of a difference, {size} instants: {seconds:.2f} s ({cpu:.2f} s of processor time); {named}")
    peaks = {size: memory(size, 30) for size in (10_000, 40_000)}
    print("memory: " + ", ".join(f"{size} instants {peak:.0f} MB" for size, peak in peaks.items()))


if __name__ == "__main__":
    main()
