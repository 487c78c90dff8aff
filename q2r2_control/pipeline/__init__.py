"""The in-process loop: input -> teleop -> control -> plant. The only room that knows them all."""
