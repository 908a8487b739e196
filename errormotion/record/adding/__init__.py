"""Files of other software as runs in the record: recognition, import, identification and report.

:func:`errormotion.record.adding.add.add` does all of it; the other modules are its parts.
"""
