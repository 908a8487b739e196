"""The runs of one or more folders: what each states, their index, selection, and decisions on their tolerances."""
