"""Datasets on disk: files and folders, compression."""
