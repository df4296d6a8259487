from .behaviour import Behaviour as Behaviour
from .file import BudgetFile as BudgetFile
from .file import load_budget_file as load_budget_file
from .file import write_budget_template as write_budget_template
from .indices import Index as Index
from .result import Budget as Budget
from .rows import Contributor as Contributor
