"""The page around the chapters: head, verdict, annex, and their assembly.

=============  ====================================================================
``verdict``    the decision on the tolerances: a sentence, a picture and a table
``head``       object, place, time and operator of the test; the laboratory; calibrations
``annex``      settings, versions and values in SI units
``assemble``   the HTML of the page
=============  ====================================================================
"""
