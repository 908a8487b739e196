"""Bench and campaign files, the runner, and the data on disk.

``files``         bench and campaign files; all mistakes of a file are reported together
``sections``      sections of these files: head, machine, limits, timeline
``claims``        exclusive use of the instruments of a machine
``bench``         the instruments of a bench, opened together
``folder``        a run folder and its ``run.json``
``storage``       raw data and log of a run on disk, complete at any time
``runner``        execution of the tests: acquire, identify, report; continuation after an interruption
``batch``         identification of many runs as a graph of small tasks, on this computer or on a cluster
``truth``         the true errors during a run on a virtual machine
``background``    campaigns in separate processes
``compensation``  compensation of a machine in operation
``form``          bench and campaign files as forms
``monitor``       temperatures and working parameters over hours
``planning``      expected uncertainty, duration and motions
"""
