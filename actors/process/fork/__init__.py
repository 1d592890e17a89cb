"""The fork server and the processes that it makes."""
