"""Names of targets and stations."""


def target_names(count: int) -> list[str]:
    """Return the names of targets: T001, T002 and so on."""
    digits = max(3, len(str(count)))
    return [f"T{i + 1:0{digits}}" for i in range(count)]


def station_names(count: int) -> list[str]:
    """Return the names of stations: S1, S2 and so on."""
    return [f"S{j + 1}" for j in range(count)]
