from .definition import TEMPLATES as TEMPLATES
from .definition import StudyDefinition as StudyDefinition
from .definition import write_study_template as write_study_template
from .result import Study as Study
