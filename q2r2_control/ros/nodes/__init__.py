"""One module for each executable, or the executables of both arms; ``launch.executables`` runs them."""
