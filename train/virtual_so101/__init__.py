"""Virtual SO-101 arms: serial ports behind which six STS3215 servos answer, for LeRobot's own drivers."""
