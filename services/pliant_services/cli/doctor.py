"""``pliant doctor``: is this installation whole?"""

import typer


def doctor() -> None:
    """Check the installation and say for each finding what to do.

    pliant doctor
    """
    from pliant_services.cli.diagnosis import diagnose

    findings = diagnose()
    for finding in findings:
        typer.echo(
            f"{finding.grade:>7}  {finding.what}"
            + (f": {finding.detail}" if finding.detail else "")
        )
    if any(finding.grade == "error" for finding in findings):
        raise typer.Exit(1)
