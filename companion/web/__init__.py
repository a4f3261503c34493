"""Web page with the state of the daemon, and three buttons. Off unless `[web]` names an address."""
