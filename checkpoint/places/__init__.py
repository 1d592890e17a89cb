"""Where the lives of recorded actors are lived: this process, one of their own, that of their supervisor."""
