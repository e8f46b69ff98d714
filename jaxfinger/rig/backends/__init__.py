"""One file a backend: `address(table)` reads its keys of [address] in the rig file, `make(description)` builds its Rig."""
