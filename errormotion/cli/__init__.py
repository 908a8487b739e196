"""The command ``errormotion``.

Start-up is part of its manners: nothing heavy is imported before a command needs it.
"""


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit.

    Parameters
    ----------
    arguments : list of str, optional
        Instead of those of the process.
    """
    from errormotion.cli.app import app

    app(arguments)
