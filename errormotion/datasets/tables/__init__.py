"""Tables in files of any program: encoding, delimiter, header, units, numbers and dates are recognised or stated."""
