"""The interface of flight and ground: mission file, packets, frames, file transfer, commands; see README.md here."""
