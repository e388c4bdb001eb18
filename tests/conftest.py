"""Its presence lets every test folder import the helpers in this one: pytest puts this folder on the path."""

import signal

# A shell's background job has Ctrl-C ignored, and its children too; tests interrupt themselves and others.
signal.signal(signal.SIGINT, signal.default_int_handler)
