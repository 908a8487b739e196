"""Files that people write and large variables: TOML, search folders, hashes, samples."""
