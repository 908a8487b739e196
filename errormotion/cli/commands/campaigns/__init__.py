"""Commands on campaigns: files, expected uncertainty, NC programs, runs in this process or in the background."""
