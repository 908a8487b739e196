"""Error datasets: building, validation, interpolation, reduction, plots, and the accessor ``ds.em``."""
