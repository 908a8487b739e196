"""A campaign as a form: the fields of its tables and of the settings of its methods, with mistakes."""
