"""The page around the chapters: head, verdict, annex, and how it is put together.

=============  ====================================================================
``verdict``    the decision on the tolerances: one sentence, one picture, one table
``head``       who measured what, where and when; the laboratory; calibrations
``annex``      settings, versions and values in SI units
``assemble``   the HTML of all of it
=============  ====================================================================
"""
