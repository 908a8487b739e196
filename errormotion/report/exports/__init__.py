"""A report in other forms: ``pdf``, and its tables as ``csv`` files or as one ``xlsx`` workbook."""
