"""Chapters and parts of chapters that do not belong to one method: any error dataset, beams."""
