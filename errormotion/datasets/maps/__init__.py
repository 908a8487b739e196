"""Maps of files of others: columns and values for the variables of a raw schema, read, proposed and written."""
