"""Its presence lets every test folder import the helpers in this one: pytest puts this folder on the path."""
