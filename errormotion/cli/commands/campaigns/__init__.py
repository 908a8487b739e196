"""Campaigns: files, uncertainty to expect, programs, and runs in this process or in the background."""
