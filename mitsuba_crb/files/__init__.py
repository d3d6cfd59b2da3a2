"""Files: read whole or refused in one line; written whole or not there; results as documents and back."""

from .reading import read_array as read_array
from .reading import read_bytes as read_bytes
from .reading import read_colours as read_colours
from .reading import read_grey as read_grey
from .reading import read_image_size as read_image_size
from .reading import read_json as read_json
from .reading import read_rows as read_rows
from .reading import read_sparse as read_sparse
from .reading import read_text as read_text
from .reading import read_toml as read_toml
from .reading import read_yaml as read_yaml
from .records import Record as Record
from .schema import Table as Table
from .schema import checked as checked
from .schema import expected as expected
from .schema import refused as refused
from .settings import changes as changes
from .writing import atomic as atomic
from .writing import jsonable as jsonable
from .writing import temporary_path as temporary_path
