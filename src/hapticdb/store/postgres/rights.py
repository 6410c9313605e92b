"""Rights of roles on an environment, enforced by the server.

A viewer reads and queries. A toucher also stores cost figures. An editor also adds, moves and
removes objects. Only the owner, the environment's creator, may change its tables and grant rights.
"""

from psycopg import sql

from hapticdb.errors import AccessError, UsageError
from hapticdb.store.engines import Right
from hapticdb.store.postgres.address import check_name
from hapticdb.store.postgres.connecting.server_connection import ServerConnection

WITHDRAWN = (
    "REVOKE ALL ON SCHEMA {schema} FROM {role}",
    "REVOKE ALL ON ALL TABLES IN SCHEMA {schema} FROM {role}",  # of their columns, too
    "REVOKE ALL ON ALL SEQUENCES IN SCHEMA {schema} FROM {role}",
    "REVOKE ALL ON ALL FUNCTIONS IN SCHEMA {schema} FROM {role}",
    "REVOKE ALL ON TYPE {schema}.hit FROM {role}",
)
VIEWER = (
    "GRANT USAGE ON SCHEMA {schema} TO {role}",
    "GRANT SELECT ON ALL TABLES IN SCHEMA {schema} TO {role}",
    # a default, but the owner may have revoked it
    "GRANT USAGE ON TYPE {schema}.hit TO {role}",
    (
        "GRANT EXECUTE ON FUNCTION {schema}.has_voxel(bytea, bigint),"
        " {schema}.add_up(double precision), {schema}.wrench_of_hits({schema}.hit[]),"
        " {schema}.force({schema}.hit) TO {role}"
    ),
)
TOUCHER = (*VIEWER, "GRANT INSERT, UPDATE ON {schema}.cost TO {role}")
EDITOR = (
    *TOUCHER,
    (
        "GRANT INSERT, UPDATE, DELETE ON {schema}.object, {schema}.voxel, {schema}.brick,"
        " {schema}.surface, {schema}.pair, {schema}.rule TO {role}"
    ),
    "GRANT INSERT ON {schema}.change TO {role}",  # no UPDATE: rows of the log stay
    "GRANT INSERT, DELETE ON {schema}.removed TO {role}",
    "GRANT INSERT, UPDATE ON {schema}.quantile TO {role}",
    "GRANT UPDATE (revision) ON {schema}.environment TO {role}",
    # UPDATE: a copy preserves ids, so the sequence must be set after them
    "GRANT USAGE, SELECT, UPDATE ON SEQUENCE {schema}.object_id_seq TO {role}",
    "GRANT EXECUTE ON FUNCTION {schema}.refresh_statistics() TO {role}",
)
GRANTED: dict[Right, tuple[str, ...]] = {
    "viewer": VIEWER,
    "toucher": TOUCHER,
    "editor": EDITOR,
    "nobody": (),
}
# a lock: two changes of the same rights at once would conflict in the server's catalog
GRANTERS = 0x4841505447524E54
KNOWN_ROLE = """
SELECT pg_has_role(role.oid, kept.relowner, 'MEMBER')
  FROM pg_roles AS role, pg_class AS kept
 WHERE role.rolname = %s AND kept.oid = 'environment'::regclass"""


def grant(connection: ServerConnection, role: str, right: Right) -> None:
    """Grant a role one right on an environment instead of its former one; one transaction.

    connection : of the environment's owner; role : a person's or a group's, unquoted. Rights
    through a group stay.

    Raises `AccessError` for a user other than the owner; `UsageError` for an unknown role, a role
    with all rights anyway, or a name above the server's 63 bytes.
    """
    check_name(role, "a role's name")
    if right not in GRANTED:
        raise UsageError(f"right {right!r}: choose one of {', '.join(GRANTED)}")
    if not connection.is_owner():
        raise AccessError(
            f"{connection.shown}: only the owner of the environment "
            f"{connection.address.environment!r} may grant rights; connect as the owner"
        )
    names = {"schema": sql.Identifier(connection.address.environment), "role": sql.Identifier(role)}

    def work() -> None:
        connection.execute("SELECT pg_advisory_xact_lock(%s)", (GRANTERS,))
        _check_role(connection, role)
        for statement in (*WITHDRAWN, *GRANTED[right]):
            connection.execute(sql.SQL(statement).format(**names))

    connection.write(work)


def _check_role(connection: ServerConnection, role: str) -> None:
    found = connection.execute(KNOWN_ROLE, (role,)).fetchone()
    if found is None:
        raise UsageError(
            f"{connection.shown}: no role {role!r} on this server; create it first with "
            "'createuser'"
        )
    if found[0]:
        raise UsageError(
            f"{connection.shown}: {role!r} is the owner, a member of the owner or a superuser, and "
            "may do everything whatever is granted; give the right to another role"
        )
