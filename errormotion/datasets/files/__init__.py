"""TOML files, search folders, safe reading and writing of files, hashes and samples of large variables."""
