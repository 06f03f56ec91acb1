"""``python -m method_configs.commands`` is the command ``fillerbuster``."""

from method_configs.commands.command_line import main

if __name__ == "__main__":
    main()
