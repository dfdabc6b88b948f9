"""From depth images to people as capsules with bounds. README.md tells how."""
