"""Commands that hand a result on: to the browser, to a spreadsheet."""
