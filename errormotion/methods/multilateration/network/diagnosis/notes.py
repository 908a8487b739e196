"""Notes on a network: outliers, targets without a position, a weak layout, swapped stations."""

from __future__ import annotations

from errormotion.methods.multilateration.network.diagnosis import determinacy, outliers
from errormotion.methods.multilateration.network.network import Network


def notes_of(network: Network) -> tuple[str, ...]:
    """Return the notes on a network for the operator."""
    return (
        *outliers.notes(network.left_out, network.undecided),
        *determinacy.without_position(network.weight, network.undecided),
        *determinacy.outside_datum(network.in_datum, network.target),
        *determinacy.weak_layout(network.target_covariance, network.weight, network.station, network.target),
        *determinacy.weak_targets(network.target, network.target_covariance, network.station),
        *determinacy.swap_note(network.station, network.approximate),
    )
