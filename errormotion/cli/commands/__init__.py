"""The commands, a folder for each group; `app` states their arguments. What they do is in the packages below."""
