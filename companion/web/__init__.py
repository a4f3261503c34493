"""The page: the state of the daemon in a browser, and three buttons. Off unless `[web]` names an address."""
