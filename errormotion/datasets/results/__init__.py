"""Error datasets: how they are built, checked, interpolated, reduced and drawn, and the accessor ``ds.em``."""
