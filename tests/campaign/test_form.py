"""A campaign as a form: the fields are those of the settings, also of foreign methods."""

from collections.abc import Callable
from pathlib import Path

from errormotion import plugins
from errormotion.campaign.form.fields import Field, Form, form_of, with_field


def _by_label(form: Form, group: int) -> dict[str, Field]:
    return {each.label: each for each in form.groups[group].fields}


def test_a_foreign_method_has_its_fields_with_units_defaults_and_messages(
    lab: None, write: Callable[..., Path]
) -> None:
    path = write('name = "a"\n[test.settings]\ncount = 3')
    form = form_of(path.read_text(), path)
    fields = _by_label(form, 1)
    settings = plugins.get("methods", "ramp").Settings.model_fields
    assert set(settings) <= set(fields)
    assert form.count == 0
    assert form.plan is not None
    assert "ramp" in fields["method"].choices
    assert fields["count"].text == "3"
    text = with_field(form.text, fields["count"].place, "many")
    (message,) = _by_label(form_of(text, path), 1)["count"].mistakes
    assert message == 'expected a whole number; found "many"'
    assert with_field(text, fields["count"].place, "3") == form.text


def test_every_method_has_a_form_of_all_its_settings(tmp_path: Path) -> None:
    head = 'schema = "errormotion.campaign/1"\nname = "x"\nbench = "bench.toml"\n'
    for each in plugins.available("methods"):
        form = form_of(f'{head}[[test]]\nname = "a"\nmethod = "{each.id}"\n', tmp_path / "campaign.toml")
        assert each.cls is not None
        keys = {field.place[3] for field in form.groups[1].fields if field.place[2] == "settings"}
        assert keys == set(each.cls.Settings.model_fields)


def test_errors_of_the_bench_are_reported_with_those_of_the_fields(tmp_path: Path) -> None:
    head = 'schema = "errormotion.campaign/1"\nname = "x"\nbench = "nowhere.toml"\nruns = "s3://x"\n'
    form = form_of(f'{head}[[test]]\nname = "a b"\nmethod = "spindle_drift"\nextra = 1\n', tmp_path / "campaign.toml")
    assert "expected" in _by_label(form, 1)["name"].mistakes[0]
    assert form.groups[1].mistakes == ("test[0].extra: unknown key; " + form.groups[1].mistakes[0].partition("; ")[2],)
    assert any("nowhere.toml: cannot be read" in each for each in form.mistakes)
    assert any(each.startswith("runs: ") for each in form.mistakes)
    assert form.count == 4
