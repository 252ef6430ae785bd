"""Names of the values that options take, in help and in messages, in place of the parser's STR, PATH or INT INT."""

VALUE_NAMES = {
    "--board STR": "COLUMNSxROWS",
    "--box FLOAT FLOAT FLOAT FLOAT FLOAT FLOAT": "X Y Z X Y Z",
    "--calibration PATH": "FILE",
    "--camera-model STR": "MODEL",
    "--camera-params STR": "FX,FY,CX,CY",
    "--cameras INT INT": "LEFT RIGHT",
    "--database PATH": "FILE",
    "--dictionary STR": "NAME",
    "--exclude STR": "PATTERN",
    "--export PATH": "FOLDER",
    "--host STR": "ADDRESS",
    "--imu-mounting PATH": "FILE",
    "--imu-units STR": "ACCEL,GYRO",
    "--include STR": "PATTERN",
    "--lengths PATH": "FILE",
    "--masks PATH": "FOLDER",
    "--odometry PATH": "FILE",
    "--odometry-mounting PATH": "FILE",
    "--pair STR STR": "LEFT RIGHT",
    "--pairs PATH": "FILE",
    "--positions PATH": "FILE",
    "--principal-point FLOAT FLOAT": "CX CY",
    "--right PATH": "FOLDER",
    "--share PATH": "FILE",
    "--tag-family STR": "FAMILY",
    "--test STR": "NAMES",
    "--time STR": "TIME",
    "--topics STR": "TOPICS",
    "--window INT INT": "WIDTH HEIGHT",
    "--workspace PATH": "FOLDER",
}
"""By option and type of its values, as the parser prints them."""


def with_value_name(option: str) -> str:
    """An option as the help shows it: `--window INT INT` becomes `--window WIDTH HEIGHT`."""
    option = option.replace("{None}|", "").replace("{None,", "{")
    name = VALUE_NAMES.get(option)
    return f"{option.split()[0]} {name}" if name else option


def value_names(option: str, count: int) -> str:
    """Names of an option's values, such as `WIDTH HEIGHT`; empty if they have no names.

    Args:
        option: name of the option.
        count: number of its values.
    """
    for key, names in VALUE_NAMES.items():
        of, *kinds = key.split()
        if of == option and len(kinds) == count:
            return names
    return ""
