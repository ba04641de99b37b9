"""The command `carom`: one file a subcommand."""
