"""A recorded run again, with something else: what each robot, landmark and message was worth."""
