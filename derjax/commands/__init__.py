"""The subcommands of `derjax`, one module each; see `derjax.commands.main`."""
