"""Bench and campaign files, the runner, and what it leaves on disk.

``files``     bench and campaign files, every mistake told at once
``bench``     the instruments of a bench, opened together
``store``     the raw data on disk, whole at every moment
``recorder``  the thread that writes while the method measures
``folder``    a run folder and its ``run.json``
``journal``   the run's ``log.jsonl``
``batch``     many runs identified as a graph of small tasks, here or on a cluster
``runner``    test by test: acquire, identify, report; and going on after an interruption
"""
