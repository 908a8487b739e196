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
    import atexit
    import gc

    # Imports make 400 000 objects that stay: looking through them for cycles again and again costs 0.1 s of 1 s,
    # and 0.2 s more when the interpreter ends.
    gc.set_threshold(100_000, 20, 20)
    atexit.register(gc.freeze)
    from errormotion.cli.app import app

    app(arguments)
