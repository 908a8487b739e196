"""The runs of one or more folders: entries, index, selection, and decisions on tolerances."""
