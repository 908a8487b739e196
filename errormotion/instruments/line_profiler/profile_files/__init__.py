"""Existing scans in files."""

from errormotion.instruments.line_profiler.profile_files.driver import ProfileFiles
from errormotion.instruments.line_profiler.profile_files.settings import ProfileFileSettings

__all__ = ["ProfileFileSettings", "ProfileFiles"]
