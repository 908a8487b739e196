"""The LG7 line gauge: a point sensor that is asked by lines of text."""
