"""Parts of the validation of comparisons."""
