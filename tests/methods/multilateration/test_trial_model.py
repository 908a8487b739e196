"""Draws of the sources: each has the spread that the result states for its group."""

import numpy as np
import pytest
from numpy.random import SeedSequence

from errormotion.methods.multilateration import Multilateration, MultilaterationSettings, simulation
from errormotion.montecarlo.trials import sample, trial_model_of, values_of
from errormotion.twin import VirtualMachine

TRIALS = 120


@pytest.mark.slow
def test_each_source_has_the_spread_of_its_group():
    machine = VirtualMachine("cframe", seed=8)
    q = simulation.target_grid(machine, (4, 4, 3))
    drift = np.tile([2e-9, 5e-10, 0.0, -3e-10], (4, 1))
    raw = simulation.raw(machine, np.concatenate([q, q[::6]]), seed=4, drift=drift)
    settings = MultilaterationSettings(expansion={"coefficient": 11.5e-6, "temperature": 23.0}, parametric=False)
    errors = Multilateration().identify(raw, settings)
    trial_model = trial_model_of(Multilateration(), raw, settings, errors)
    F, groups = errors["influence"].values[..., :3], errors["source_group"].values
    own = np.einsum("tii->ti", errors["covariance"].values[:, :3, :3]) - (F**2).sum(axis=0)
    assert set(groups) == {group for source in trial_model.sources.values() for group in source.groups} & set(groups)
    assert {"readings", "drift", "refraction", "scale of the tracker", "scales"} == set(trial_model.sources)
    for name, source in trial_model.sources.items():
        stated = (F[np.isin(groups, source.groups)] ** 2).sum(axis=0) + (own if source.own else 0.0)
        values, refused = sample(
            Multilateration(), trial_model, SeedSequence(2), range(TRIALS), values_of(errors).shape, only=[name]
        )
        assert not refused
        found = np.nanvar(values[..., :3], axis=0, ddof=1)
        # One independent draw a trial, as of a scale: the spread scatters by 1 / sqrt(2 n) = 6 %.
        assert np.sqrt(np.nanmean(found) / np.nanmean(stated)) == pytest.approx(1.0, abs=4 / np.sqrt(2 * TRIALS)), name
