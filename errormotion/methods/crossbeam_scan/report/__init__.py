"""Report chapter: crossbeam scans."""
