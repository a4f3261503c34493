"""Accelerometers of an aircraft that somebody turns and props up, without a gradienter."""
