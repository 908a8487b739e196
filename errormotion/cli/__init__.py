"""The command ``errormotion``.

A package that is slow to import is imported only when a command needs it, so that every command starts quickly.
"""


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit.

    Parameters
    ----------
    arguments : list of str, optional
        Arguments of the command line; default: those of the process.
    """
    import atexit
    import gc

    # Imports create 400 000 permanent objects: with the default thresholds, collecting garbage takes 0.1 s of 1 s, and
    # 0.2 s more at the end of the process.
    gc.set_threshold(100_000, 20, 20)
    atexit.register(gc.freeze)
    from errormotion.cli.app import app

    app(arguments)
