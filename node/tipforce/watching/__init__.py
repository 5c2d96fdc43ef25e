"""All fingers that a bus, a hand or a log shows, as blocks of contacts and events; nothing is sent."""
