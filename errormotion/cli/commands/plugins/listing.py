"""``errormotion plugins list``, ``show`` and ``check``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from errormotion import plugins
from errormotion.campaign.form.written import default_of
from errormotion.cli.output import failure, show, show_json, table
from errormotion.errors import PluginError


def list_plugins(as_json: bool) -> None:
    """Print every plugin of the registry."""
    found: list[dict[str, Any]] = []
    for group in plugins.GROUPS:
        for plugin in plugins.available(group):
            info = plugin.cls.info if plugin.cls else None
            found.append(
                {
                    "group": group,
                    "id": plugin.id,
                    "kind": getattr(info, "kind", ""),
                    "status": getattr(info, "status", "") if info else "broken",
                    "version": info.version if info else "",
                    "distribution": plugin.distribution,
                    "summary": info.summary if info else "",
                    "error": plugin.error,
                }
            )
    if as_json:
        show_json({"plugins": found})
        return
    several = len({p["distribution"] for p in found}) > 1
    for group in plugins.GROUPS:
        own = [p for p in found if p["group"] == group]
        columns = ["id", *(["kind"] if any(p["kind"] for p in own) else []), "status"]
        columns += ["distribution"] if several else []
        rows = [[*(p[column] for column in columns), p["error"] or p["summary"]] for p in own]
        show(f"{group.replace('_', ' ')} ({len(own)})\n")
        show(table(["from" if column == "distribution" else column for column in [*columns, "summary"]], rows) + "\n")


def show_plugin(plugin_id: str, as_json: bool) -> None:
    """Print the description of a plugin and its settings."""
    group = group_of(plugin_id)
    cls = plugins.get(group, plugin_id)
    settings = getattr(cls, "Settings", None)
    if as_json:
        schema = settings.model_json_schema() if settings else {}
        show_json({"group": group, "info": asdict(cls.info), "settings": schema})
        return
    stated = [
        [key.replace("_", " "), ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)]
        for key, value in asdict(cls.info).items()
        if key != "id" and value not in (None, "", ())
    ]
    if hasattr(cls, "needs"):
        stated.append(["needs", f"{', '.join(cls.needs.instruments)}; raw schema {cls.needs.raw_schema}"])
    show(table(["plugin", plugin_id], stated))
    fields = settings.model_fields if settings else {}
    rows = [[name, default_of(field), str(field.description or "")] for name, field in fields.items()]
    show()
    show(table(["setting", "default", "meaning"], rows) if rows else "This plugin has no settings.")


def check_plugin(plugin_id: str, address: str | None, mutants: int | None, only: Sequence[str], as_json: bool) -> bool:
    """Run the conformance kit on a plugin, or some of its checks; print each, and return whether all passed."""
    from errormotion import testing
    from errormotion.campaign.claims import claimed, use_of

    with claimed([] if address is None else [use_of(address)], "a check of a plugin"):
        results = testing.check_plugin(group_of(plugin_id), plugin_id, address=address, mutants=mutants, only=only)
    bad = [f"{result.name}: {result.message}" for result in results if not result.ok]
    good = not bad
    if as_json:
        error = failure("\n".join(bad), code="plugin.checks.failed") if bad else {}
        show_json({"ok": good, "plugin": plugin_id, "checks": [asdict(result) for result in results], **error})
        return good
    rows = [["-" if r.skipped else "ok" if r.ok else "FAILED", r.name, f"{r.seconds:.2f}", r.message] for r in results]
    show(table(["", "check", "seconds", "message"], rows))
    failed = sum(not result.ok for result in results)
    show(f"{plugin_id}: " + ("passes" if good else f"{failed} of {len(results)} checks failed"))
    return good


def group_of(plugin_id: str) -> plugins.Group:
    """Return the group of an id; PluginError names the nearest ids of all groups."""
    found = [group for group in plugins.GROUPS if plugin_id in {plugin.id for plugin in plugins.available(group)}]
    if len(found) == 1:
        return found[0]
    if found:
        raise PluginError(
            f"'{plugin_id}' is the id of a plugin in each of the groups {' and '.join(found)}; rename one",
            code="plugin.ambiguous",
        )
    from errormotion.datasets.files.tomlfile import nearest

    names = [plugin.id for group in plugins.GROUPS for plugin in plugins.available(group)]
    raise PluginError(f"No plugin '{plugin_id}'; {nearest(plugin_id, names)}", code="plugin.unknown")
