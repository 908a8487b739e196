"""The LG7 line gauge: a point sensor with a protocol of text lines."""
