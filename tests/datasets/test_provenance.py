import json

import numpy as np
from pydantic import BaseModel

from errormotion.datasets import hash_dataset, provenance
from errormotion.datasets.units import Length


class Settings(BaseModel):
    radius: Length = 0.005
    limit: float = float("inf")


def test_provenance_contains_settings_with_defaults_hash_and_software(drift) -> None:
    raw = drift()
    found = provenance.make(Settings(), raw, [{"serial_number": "7"}], seed=3, steps=("averaged",))
    assert found["settings"] == {"radius": 0.005, "limit": "inf"}
    assert found["raw"] == {"schema": raw.attrs["schema"], "hash": hash_dataset(raw)}
    assert found["instruments"] == [{"serial_number": "7"}]
    assert {"errormotion", "numpy", "python"} <= set(found["software"])
    assert (found["seed"], found["steps"]) == (3, ["averaged"])
    assert json.loads(json.dumps(found, allow_nan=False)) == found


def test_the_same_work_has_the_same_provenance(drift) -> None:
    assert provenance.make(Settings(), drift(), []) == provenance.make(Settings(), drift(), [])


def test_instruments_are_taken_from_the_raw_dataset_unless_stated(drift) -> None:
    raw = drift().assign_attrs(instruments=json.dumps([{"address": "sim://a"}]))
    assert provenance.make({}, raw, None)["instruments"] == [{"address": "sim://a"}]
    assert provenance.make({}, raw, [])["instruments"] == []


def test_an_error_dataset_has_its_provenance(errors) -> None:
    assert provenance.of(errors())["settings"] == {"average": 0.5}


def test_an_identity_is_that_of_the_calibration_and_the_part() -> None:
    a, C = np.arange(3.0), np.eye(3)
    one = provenance.identity(a, C, part="part 1", along=(0.6, -0.8))
    assert one == provenance.identity(a.copy(), C, part="part 1", along=(0.6 + 1e-12, -0.8))
    assert one.startswith("sha256:")
    assert one.endswith("/part 1")
    others = [
        provenance.identity(a, C, part="part 2", along=(0.6, -0.8)),
        provenance.identity(a, C, part="part 1", along=(-0.6, 0.8)),
        provenance.identity(a + 1e-15, C, part="part 1", along=(0.6, -0.8)),
        provenance.identity(C, a, part="part 1", along=(0.6, -0.8)),
        provenance.identity("certificate 4711", part="part 1"),
    ]
    assert len({one, *others}) == 6
