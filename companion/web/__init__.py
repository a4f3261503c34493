"""Web page that shows the state of the daemon and has three buttons. Off unless the section [web] sets an address."""
