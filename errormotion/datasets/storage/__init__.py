"""Datasets on disk: files and folders, compression, and the engine of xarray."""
