"""Drawings of several kinds on the canvas: series over time, timelines, maps, spatial views."""
