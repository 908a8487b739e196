"""The command line in this process; its commands are built once, not for each call."""

from functools import cache

from typer import testing

testing._get_command = cache(testing._get_command)

CliRunner, Result = testing.CliRunner, testing.Result
