"""Bench and campaign files, the runner, and what it leaves on disk.

``files``         bench and campaign files, every mistake reported at once
``sections``      what such files state: head, machine, limits, timeline
``bench``         the instruments of a bench, opened together
``folder``        a run folder and its ``run.json``
``storage``       raw data and log of a run on disk, complete at any time
``runner``        test by test: acquire, identify, report; and continuation after an interruption
``batch``         many runs identified as a graph of small tasks, in this computer or on a cluster
``truth``         the true errors behind a run on a virtual machine
``background``    campaigns in processes of their own
``compensation``  compensation of a machine while it works
``form``          bench and campaign files as forms
``monitor``       temperatures and working parameters over hours
``planning``      uncertainty, duration and motions to expect
"""
